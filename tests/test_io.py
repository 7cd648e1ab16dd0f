"""Files: whole or not at all, inside their folder, and of a known format."""

import errno
import json
import os
from pathlib import Path

import pytest

from unbake import io
from unbake.config import from_toml, read_toml
from unbake.errors import UserError
from unbake.formats import check_format
from unbake.io import (
    filled_folder,
    inside,
    number,
    read_json,
    read_object,
    read_text,
    relative,
    remove_unfinished,
    require_writable_file,
    require_writable_folder,
    unfinished,
    write_atomically,
    write_json,
    write_text,
)


@pytest.mark.parametrize("durable", [False, True])
def test_a_durable_file_is_on_the_disk_before_it_has_its_name(durable, tmp_path, monkeypatch):
    file, seen = tmp_path / "new" / "a.json", []
    sync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: seen.append(file.exists()) or sync(number))
    write_json(file, {"a": [1, 2]}, durable=durable)
    assert seen == ([False] if durable else [])
    assert json.loads(file.read_text()) == {"a": [1, 2]}
    assert [p.name for p in file.parent.iterdir()] == ["a.json"]


def test_a_full_disk_leaves_the_old_file_and_is_told_in_short(tmp_path, monkeypatch):
    file = tmp_path / "a.txt"
    write_text(file, "old")

    def full(number):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError) as caught:
        write_text(file, "new", durable=True)
    assert str(caught.value) == f"{file}: the file cannot be written (No space left on device)"
    assert file.read_text() == "old" and list(tmp_path.iterdir()) == [file]


def test_settings_of_windows_may_begin_with_the_mark_of_their_byte_order(tmp_path):
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfsteps = 7\n")
    assert read_toml(tmp_path / "a.toml").steps == 7


def test_numbers_that_json_lacks_leave_no_file(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", float("nan"), allow_nan=False)
    assert not list(tmp_path.iterdir())


def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path):
    keep = [tmp_path / name for name in ("a.txt", "b.tmp", ".hidden")]
    for file in keep:
        file.write_text("mine")
    temporary = []

    def die(path):
        path.write_text("half")
        temporary.append(path)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "a.txt", die)
    assert not temporary[0].exists()
    temporary[0].write_text("half")
    remove_unfinished(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(keep)
    remove_unfinished(tmp_path / "none")


@pytest.mark.parametrize("name", ["../b", "a/../../b", "/etc/passwd", "link/b"])
def test_a_path_may_not_leave_its_folder(name, tmp_path):
    folder = tmp_path / "data"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    with pytest.raises(UserError, match=r"a\.json: frame 3: .* lies outside the folder"):
        inside(folder, name, "a.json: frame 3")
    with pytest.raises(UserError, match="lies outside the data set"):
        relative(folder, folder / name, "data set")


def test_a_path_inside_is_relative_and_back(tmp_path):
    assert inside(tmp_path, "a/../b/c.exr", "here") == tmp_path / "a/../b/c.exr"
    assert relative(tmp_path, tmp_path / "a" / ".." / "b" / "c.exr") == "b/c.exr"
    with pytest.raises(UserError, match="is not a path"):
        inside(tmp_path, "a\0b", "here")


def test_what_is_not_text_or_no_object_is_named(tmp_path):
    file = tmp_path / "a.json"
    with pytest.raises(UserError, match=r"a\.json: the file does not exist. Make it"):
        read_object(file, "Make it")
    with pytest.raises(UserError, match=r"a\.json: the file does not exist. Check the path"):
        read_text(file)
    file.write_text("[1]")
    with pytest.raises(UserError, match=r"a\.json: the file does not hold a JSON object"):
        read_object(file)
    file.write_bytes(b"\xff{}")
    with pytest.raises(UserError, match=r"a\.json: the file is not UTF-8 text"):
        read_text(file)
    with pytest.raises(UserError, match=r"a\.json: the file is not UTF-8 text"):
        read_object(file)
    with pytest.raises(UserError, match=r"cannot be read .Is a directory"):
        read_text(tmp_path)


def test_a_json_file_is_neither_endless_nor_deep(tmp_path, monkeypatch):
    file = tmp_path / "a.json"
    for depth, fine in ((64, True), (65, False), (900, False), (100_000, False)):
        file.write_text("[" * depth + "]" * depth)
        if fine:
            read_json(file)
        else:
            with pytest.raises(UserError, match="not readable JSON"):
                read_json(file)
    monkeypatch.setattr(io, "LONGEST_TEXT", 1000)
    file.write_text(" " * 1001)
    with pytest.raises(UserError, match=r"has 0 MB, more than the 0 MB that are read"):
        read_json(file)


@pytest.mark.parametrize("content", ["NaN", "Infinity", "-Infinity", "1e999", "1" * 400])
def test_numbers_are_finite(content, tmp_path):
    (tmp_path / "a.json").write_text(f'{{"x": {content}}}')
    with pytest.raises(UserError, match=r"'x' is (too large|nan|inf|-inf)"):
        number(read_object(tmp_path / "a.json"), "x", "here")


def test_nothing_is_written_through_a_link_that_waits_at_the_temporary_name(tmp_path):
    """It was `.a.txt.PID.tmp`, and a folder of someone else's may have links at all of them."""
    victim = tmp_path / "victim"
    victim.write_text("mine")
    folder = tmp_path / "data"
    folder.mkdir()
    (folder / f".a.txt.{os.getpid()}.tmp").symlink_to(victim)
    (folder / "a.txt").symlink_to(victim)
    write_text(folder / "a.txt", "new")
    assert victim.read_text() == "mine"
    assert (folder / "a.txt").read_text() == "new" and not (folder / "a.txt").is_symlink()


def test_a_format_is_the_first_unless_it_says_another():
    assert check_format({}, 1, "here") == 1
    assert check_format({"format": 2}, 3, "here") == 2
    with pytest.raises(UserError) as caught:
        check_format({"format": 4}, 3, "here")
    assert str(caught.value) == (
        "here: was written by a newer unbake (format 4; this one reads up to 3). Update unbake"
    )


@pytest.mark.parametrize("link", [False, True])
def test_no_device_is_replaced_by_a_file(link, tmp_path):
    """`unbake report RUN --out /dev/null` made it a file where root ran it."""
    device, name = tmp_path / "device", tmp_path / "name"
    os.mkfifo(device)
    if link:
        name.symlink_to(device)
    else:
        name = device
    with pytest.raises(UserError, match="there is a pipe or a device") as caught:
        write_text(name, "text")
    assert str(name) in str(caught.value)
    assert device.is_fifo() and name.is_symlink() == link
    assert {p.name for p in tmp_path.iterdir()} == {"device", name.name}


@pytest.mark.parametrize(
    ("content", "why"),
    [("[" * 100_000, "nested too deep"), ("1" * 5000, "a number has too many digits")],
)
def test_limits_of_the_parser_are_told_in_plain_words(content, why, tmp_path):
    file = tmp_path / "a.json"
    file.write_text(content)
    with pytest.raises(UserError) as caught:
        read_json(file)
    assert str(caught.value) == f"{file}: the file is not readable JSON ({why}). Repair it"
    with pytest.raises(UserError, match="not valid TOML") as caught:
        from_toml("a = " + content[:10_000])
    assert f"({why})" in str(caught.value)


def test_an_empty_folder_is_filled_and_nothing_is_left_of_a_failure(tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    number = out.stat().st_ino
    monkeypatch.chdir(out)
    with pytest.raises(ZeroDivisionError), filled_folder(Path()) as folder:
        (folder / "a.txt").write_text(str(1 / 0))
    assert not any(out.iterdir())
    with filled_folder(Path()) as folder:
        write_text(folder / "b" / "c.txt", "c")
        write_text(folder / "a.txt", "a")
        assert not (out / "a.txt").exists()
    assert sorted(path.name for path in out.iterdir()) == ["a.txt", "b"]
    assert out.stat().st_ino == number, "the folder is the same, as a mount has to be"
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(UserError, match="another program has written"), filled_folder(other):
        write_text(other / "theirs.txt", "")
    assert [path.name for path in other.iterdir()] == ["theirs.txt"]
    (tmp_path / "there").mkdir()
    with pytest.raises(ZeroDivisionError), filled_folder(tmp_path / "there" / "a" / "b") as folder:
        raise ZeroDivisionError
    assert not list((tmp_path / "there").iterdir())
    with filled_folder(tmp_path / "new" / "folder") as folder:
        write_text(folder / "a.txt", "a")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["folder"]


@pytest.mark.parametrize("check", [require_writable_file, lambda path: write_text(path, "text")])
def test_a_folder_is_no_name_of_a_file(check, tmp_path, monkeypatch):
    """`.` has no name, which ended in a traceback after the work was done."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a").mkdir()
    (tmp_path / "link").symlink_to("a")
    for path in (Path(), Path(".."), Path("/"), Path("a"), Path("link")):
        with pytest.raises(UserError, match=r"\(there is a folder\). Give the name of a file"):
            check(path)
    assert {path.name for path in tmp_path.iterdir()} == {"a", "link"}


def test_whether_a_file_can_be_written_is_told_before_and_nothing_is_left(tmp_path):
    file = tmp_path / "new" / "folder" / "a.json"
    require_writable_file(file)
    require_writable_folder(file.parent)
    assert not list(tmp_path.iterdir())
    write_text(file, "old")
    require_writable_file(file)
    require_writable_folder(file.parent)
    assert file.read_text() == "old" and list(file.parent.iterdir()) == [file]
    with pytest.raises(UserError, match=r"b\.json: the page cannot be written \(\w+"):
        require_writable_file(file / "b.json", "page")
    with pytest.raises(UserError, match=r"a\.json: is not a folder. Give another --out"):
        require_writable_folder(file)
    with pytest.raises(UserError, match=r"b: the folder cannot be written \(\w+"):
        require_writable_folder(file / "b")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="there is a pipe or a device"):
        require_writable_file(tmp_path / "pipe")


def test_unfinished_files_are_those_of_one_file_alone(tmp_path):
    def die(path):
        found.append(path.name)
        path.write_text("half")
        raise Killed

    class Killed(BaseException):
        pass

    found, file = [], tmp_path / "a.json"
    assert unfinished(tmp_path / "none" / "a.json") == []
    with pytest.raises(Killed):
        write_atomically(file, die)
    left = tmp_path / found[0]
    for name in (left.name, ".a.json.17.tmp", ".a.json.tmp", ".b.json.17.tmp", ".a.json.x.tmp"):
        (tmp_path / name).write_text("half")
    assert {path.name for path in unfinished(file)} == {left.name, ".a.json.17.tmp"}
