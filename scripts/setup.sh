#!/usr/bin/env bash
# Makes .venv in the checkout with colmap-inertial, and compiles its kernels. Installs missing system packages with apt
# where it may; otherwise it says what is missing.
#   setup.sh [--browser] [EXTRA ...]    extras of pyproject.toml to install along: dev for the tests, view, ros, ...
#                                       (default: none); --browser installs Chromium for the tests where it is missing
# Running it again is quick; after a change of pyproject.toml or of the C++ sources, or with another extra, it installs
# again, those of earlier times included. What pip is told by its own variables holds (PIP_EXTRA_INDEX_URL, PIP_FIND_LINKS):
# so torch comes without CUDA.
set -euo pipefail
cd "$(dirname "$0")/.."

browser=()
if [ "${1:-}" = "--browser" ]; then
  shift
  command -v chromium >/dev/null || browser+=("chromium")
  command -v chromedriver >/dev/null || browser+=("chromium-driver")
fi

python=""
for candidate in python3.11 python3.12 python3.13 python3.14 python3; do
  if command -v "$candidate" >/dev/null && "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    python=$candidate
    break
  fi
done
if [ -z "$python" ]; then
  echo "setup: Python 3.11 or newer is needed (apt-get install python3.11)" >&2
  exit 2
fi

missing=()
"$python" -c 'import ensurepip' 2>/dev/null || missing+=("python3-venv")
command -v g++ >/dev/null || missing+=("g++")
"$python" -c 'import os, sys, sysconfig; sys.exit(not os.path.exists(sysconfig.get_path("include") + "/Python.h"))' ||
  missing+=("libpython3-dev")
# The stamp holds the extras that are there, one a line.
stamp=.venv/.colmap-inertial
extras=$({ printf '%s\n' "$@"; cat "$stamp" 2>/dev/null || true; } | sed '/^$/d' | sort -u)
# What open3d's wheels take from the system.
if grep -qxE 'mesh|complete' <<<"$extras"; then
  for pair in libusb-1.0.so.0=libusb-1.0-0 libGL.so.1=libgl1 libgomp.so.1=libgomp1 libX11.so.6=libx11-6; do
    "$python" -c "import ctypes; ctypes.CDLL('${pair%%=*}')" 2>/dev/null || missing+=("${pair#*=}")
  done
fi
sudo=""
if [ "$(id -u)" -ne 0 ]; then sudo="sudo -n"; fi
has_apt() { command -v apt-get >/dev/null && $sudo true 2>/dev/null; }
apt_install() {
  echo "setup: installing $* with apt"
  $sudo apt-get update -qq &&
    DEBIAN_FRONTEND=noninteractive $sudo apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}
if [ ${#missing[@]} -gt 0 ]; then
  if ! has_apt; then
    echo "setup: please install these packages and run this again: ${missing[*]}" >&2
    exit 2
  fi
  apt_install "${missing[@]}"
fi
# The browser comes while Python's packages do. Without one, its tests are skipped.
if [ ${#browser[@]} -gt 0 ]; then
  (has_apt && apt_install "${browser[@]}" ||
    echo "setup: the report's page is not tested in a browser; please install ${browser[*]} for that" >&2) &
  trap 'wait' EXIT
fi

if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
  "$python" -m venv .venv
fi
sources=(pyproject.toml colmap_inertial/_kernels/{CMakeLists.txt,*.cpp,*.h})
if [ ! -f "$stamp" ] || [ "$extras" != "$(cat "$stamp")" ] ||
  [ -n "$(find "${sources[@]}" -newer "$stamp" -print -quit)" ]; then
  names=$(paste -sd, <<<"$extras")
  echo "setup: installing Python packages${names:+ for $names} into .venv, and compiling; some minutes the first time"
  # what the package and its extras ask for, those that an extra takes from others included
  wanted=$("$python" - $extras <<'END'
import re, sys, tomllib

with open("pyproject.toml", "rb") as file:
    project = tomllib.load(file)["project"]


def asked(lines):
    for line in lines:
        own = re.fullmatch(re.escape(project["name"]) + r"\[(.+)\]", line)
        for name in own[1].split(",") if own else ():
            if name not in project["optional-dependencies"]:
                sys.exit(f"setup: pyproject.toml has no extra {name}")
            yield from asked(project["optional-dependencies"][name])
        if not own:
            yield line


own = [f"{project['name']}[{name}]" for name in sys.argv[1:]]
print(*dict.fromkeys(asked(project["dependencies"] + own)), sep="\n")
END
  )
  mapfile -t wanted <<<"$wanted"
  # make compiles one file at a time where nobody says otherwise. Python's modules are compiled when they are first
  # used: most never are.
  export CMAKE_BUILD_PARALLEL_LEVEL="${CMAKE_BUILD_PARALLEL_LEVEL:-$(getconf _NPROCESSORS_ONLN)}"
  install() {
    .venv/bin/python -m pip install --disable-pip-version-check --progress-bar on --no-compile "$@" |
      sed -un 's/^ *\(Downloading .*\|Using cached .*\)/  \1/p; s/^ *\(Building .*\)/  \1/p; s/^\(Installing\) collected packages.*/  \1/p'
  }
  # Compiling keeps the processors busy, downloading and unpacking hardly: both at once.
  (install --no-deps --editable .) &
  compiling=$!
  install "${wanted[@]}" && installed=0 || installed=$?
  wait "$compiling"
  [ "$installed" -eq 0 ] || exit "$installed"
  printf '%s\n' "$extras" | sed '/^$/d' >"$stamp"
fi
