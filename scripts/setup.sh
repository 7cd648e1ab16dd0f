#!/usr/bin/env bash
# Creates .venv with unbake in it and makes sure that an LLVM is there for Dr.Jit. Safe to run again.
#
#   setup.sh [EXTRA]     EXTRA: an extra of pyproject.toml to install too, such as dev
#
#   PYTHON               the interpreter to build on (default: the first python3 >= 3.10 found)
#   DRJIT_LIBLLVM_PATH   the LLVM shared library to use (default: the newest installed)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
VENV_PYTHON=.venv/bin/python

say() { printf 'setup: %s\n' "$*"; }
die() {
  printf 'setup: %s\n' "$@" >&2
  exit 1
}

# Runs apt-get as root, silent unless it fails; status 1 where it or the right to use it is missing.
apt() {
  command -v apt-get >/dev/null || return 1
  local output run=(env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=300)
  if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null && sudo -n true 2>/dev/null || return 1
    run=(sudo -n "${run[@]}")
  fi
  output=$("${run[@]}" "$@" 2>&1) || {
    printf '%s\n' "$output" >&2
    return 1
  }
}

new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; }

find_python() {
  local candidate
  if [ -n "${PYTHON:-}" ]; then
    command -v "$PYTHON" >/dev/null || die "PYTHON=$PYTHON: there is no such command"
    new_enough "$PYTHON" || die "PYTHON=$PYTHON: unbake needs Python 3.10 or newer"
    echo "$PYTHON"
    return
  fi
  for candidate in python3 python3.13 python3.12 python3.11 python3.10; do
    if command -v "$candidate" >/dev/null && new_enough "$candidate"; then
      echo "$candidate"
      return
    fi
  done
  die "no Python 3.10 or newer was found" "install one, or name it: PYTHON=/path/to/python3 make setup"
}

can_make_venv() { "$1" -c 'import venv, ensurepip' 2>/dev/null; }

make_venv() {
  local python package
  python=$(find_python)
  if ! can_make_venv "$python"; then
    # Debian and Ubuntu keep ensurepip in a package of its own.
    package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
    say "$python cannot make environments; installing $package"
    { apt update && apt install -y --no-install-recommends "$package"; } || true
    can_make_venv "$python" || die "$python has no venv with ensurepip" \
      "install it (Debian, Ubuntu: apt-get install $package) and run make setup again"
  fi
  say "creating .venv with $("$python" --version)"
  "$python" -m venv --clear .venv
}

# Exit status 0: a usable LLVM; it is printed. 1: none; the reason and the remedy are printed.
check_llvm() {
  "$VENV_PYTHON" - <<'PY'
import sys
from unbake import backend

problem = backend.llvm_problem()
print(problem or backend.find_llvm())
sys.exit(problem is not None)
PY
}

has_gpu() {
  "$VENV_PYTHON" -c 'import sys; from unbake import backend as b
sys.exit(not (b.cuda_driver() and b.optix()))'
}

# The package to install: libllvm19 where there is one, else the newest from 17 on.
llvm_package() {
  local names
  names=$(apt-cache search --names-only '^libllvm[0-9]+(t64)?$' | awk '{print $1}' | sort -V)
  if grep -qx libllvm19 <<<"$names"; then
    echo libllvm19
  else
    awk '{ n = $1; gsub(/^libllvm|t64$/, "", n); if (n + 0 >= 17) last = $1 } END { print last }' <<<"$names"
  fi
}

install_llvm() {
  local package
  apt update || return 1
  package=$(llvm_package)
  [ -n "$package" ] || return 1
  say "installing $package"
  apt install -y --no-install-recommends "$package"
}

ensure_llvm() {
  local found
  if found=$(check_llvm); then
    say "using $found"
    return
  fi
  # A library somebody chose is theirs to correct: one more package would not be used.
  [ -z "${DRJIT_LIBLLVM_PATH:-}" ] || die "$found"
  say "$found"
  install_llvm || say "no LLVM could be installed with apt-get here (not root, no sudo, or no package)"
  if found=$(check_llvm); then
    say "using $found"
  elif has_gpu; then
    say "no LLVM, so only the GPU can be used"
  else
    die "LLVM is missing, and this machine has no GPU to do without it" \
      "Debian, Ubuntu: apt-get install libllvm19     Fedora: dnf install llvm-libs     macOS: brew install llvm" \
      "where it is installed in an unusual place: export DRJIT_LIBLLVM_PATH=/path/to/libLLVM.so" \
      "then run make setup again"
  fi
}

if ! "$VENV_PYTHON" -m pip --version >/dev/null 2>&1; then
  make_venv
fi
extra=${1:+[$1]}
size='450 MB'
[ -z "$extra" ] || size='850 MB'
say "installing unbake$extra and what it needs into .venv (about $size on disk)"
"$VENV_PYTHON" -m pip install --quiet --disable-pip-version-check -e ".$extra"
ensure_llvm
say "done: .venv/bin/unbake --help"
