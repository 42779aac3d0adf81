#!/usr/bin/env bash
# Runs the quick tests with the lowest versions of all direct dependencies that pyproject.toml allows, in .venv-lowest.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}
"$python" -m venv --clear .venv-lowest
# "name>=floor,<end" becomes "name==floor"; what these need themselves is the newest that fits
mapfile -t lowest < <("$python" - <<'END'
import re, tomllib

with open("pyproject.toml", "rb") as file:
    project = tomllib.load(file)["project"]
extras = project["optional-dependencies"]


def asked(lines):
    for line in lines:
        own = re.fullmatch(re.escape(project["name"]) + r"\[(.+)\]", line)
        yield from (asked(more for name in own[1].split(",") for more in extras[name]) if own else [line])


for line in dict.fromkeys(asked([*project["dependencies"], *extras["dev"]])):
    print(re.sub(r">=([^,;]+)(,<[^;]+)?", r"==\1", line))
END
)
.venv-lowest/bin/python -m pip install --quiet --disable-pip-version-check --no-compile "${lowest[@]}"
.venv-lowest/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 .venv-lowest/bin/python -m pytest --quick --numprocesses "${1:-auto}" \
  --dist loadfile --no-loadscope-reorder
