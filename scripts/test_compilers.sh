#!/usr/bin/env bash
# Build wheels with GCC and with Clang, install each alone, and run the kernels' tests on it. A warning is an error.
#
#     bash scripts/test_compilers.sh [COMPILER ...]     (default: g++ clang++)
#
# Apple Clang is not tested: there is none beside a Mac. Needs python3.11, the compilers, and an index of packages.
set -euo pipefail
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
for compiler in "${@:-g++ clang++}"; do
  for one in $compiler; do
    "${PYTHON:-python3.11}" -m venv "$work/$one"
    CXX=$one CXXFLAGS=-Werror "$work/$one/bin/pip" wheel -q --no-deps -w "$work/$one/wheel" \
      -C build-dir="$work/$one/build" .
    "$work/$one/bin/pip" install -q "$work/$one"/wheel/*.whl pytest
    cp -r tests pyproject.toml "$work/$one/"
    (cd "$work/$one" && bin/python -m pytest -q -p no:cacheprovider \
      tests/inertial/core/test_kernels.py tests/imaging/test_path_filters.py)
    echo "$one: the wheel passes the kernels' tests"
  done
done
