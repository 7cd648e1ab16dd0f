"""Hooks of the documentation site: pages made from other files, and links out of docs/.

MkDocs calls `on_files` and `on_page_markdown`; mkdocs.yml names this file.
"""

import re
from pathlib import Path

from mkdocs.structure.files import File, Files

import unbake

ROOT = Path(__file__).parents[1]
#: Pages that lie at the root of the repository, where people and forges look for them.
AT_THE_ROOT = {
    "index.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "security.md": "SECURITY.md",
}
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?:|#)([^)#\s]+)(#[^)\s]*)?\)")


def on_files(files: Files, config) -> Files:
    """Add the pages that are made here."""
    pages = {page: (ROOT / name).read_text("utf-8") for page, name in AT_THE_ROOT.items()}
    pages |= {"reference/index.md": public_api(), "reference/modules.md": modules()}
    for page, text in pages.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page, config, files: Files) -> str:
    """Make links fit the site."""
    name = page.file.src_uri
    source = ROOT / AT_THE_ROOT.get(name, f"docs/{name}")

    def fitting(match: re.Match) -> str:
        text, target, anchor = match[1], match[2], match[3] or ""
        path = (source.parent / target).resolve()
        for here, there in AT_THE_ROOT.items():
            if path == ROOT / there:
                return f"[{text}]({'../' * name.count('/')}{here}{anchor})"
        inside = path.is_relative_to(ROOT / "docs") and path.is_file()
        if path.exists() and not inside:
            return text  # sources, results, folders: there in the repository, not on the site
        return match[0]

    markdown = _LINK.sub(fitting, markdown)
    if name in AT_THE_ROOT:
        markdown = re.sub(r"\]\(docs/", "](", markdown)
    return markdown


def public_api() -> str:
    """The page of the names of `import unbake`, in the order of its list."""
    lines = ["# Public API\n", "`import unbake` and use these names: `unbake.fit(…)`.\n"]
    for module, names in unbake._MODULES.items():
        lines.append(f"## unbake.{module}\n")
        lines += [f"::: unbake.{module}.{name}\n" for name in names]
    return "\n".join(lines)


def modules() -> str:
    """The page that tells of each module what it is for."""
    lines = ["# Modules\n", "Layer by layer; `pyproject.toml` holds who may import whom.\n"]
    folder = ROOT / "src" / "unbake"
    for path in sorted(folder.rglob("*.py")):
        if path.stem == "__main__" or path == folder / "__init__.py":
            continue
        name = ".".join(path.relative_to(folder).with_suffix("").parts)
        first = path.read_text("utf-8").split('"""')
        summary = first[1].strip().partition("\n\n")[0].replace("\n", " ") if first[1:] else ""
        name = name.removesuffix(".__init__")
        depth = name.count(".")
        lines.append(f"{'    ' * depth}- `{name}`: {summary}")
    return "\n".join(lines) + "\n"
