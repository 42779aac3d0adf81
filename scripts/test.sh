#!/usr/bin/env bash
# Sets everything up and runs all checks: lint, types, tests.
#   test.sh --quick       the tests that take seconds only: under two minutes on two cores
#   test.sh --no-skips    a test that cannot run here is a failure: installs what all of them need (torch, open3d and
#                         scikit-image among it), and needs the recordings in ../shared
set -euo pipefail
cd "$(dirname "$0")/.."

# The report's page is tested in a browser.
case " $* " in
  *" --no-skips "*) bash scripts/setup.sh --browser dev complete ;;
  *" --quick "*) bash scripts/setup.sh dev ;;
  *) bash scripts/setup.sh --browser dev ;;
esac

.venv/bin/ruff check .
.venv/bin/ruff format --check .
# Types, those of the docs' examples too, are checked on one processor while the tests begin on the others; what was found
# is said at the end.
types=$(mktemp -d)
checking=""
trap '[ -z "$checking" ] || kill "$checking" 2>/dev/null || true; rm -rf "$types"' EXIT
mkdir "$types/examples"
.venv/bin/python scripts/doc_examples.py "$types/examples"
.venv/bin/mypy colmap_inertial "$types/examples" >"$types/found.txt" 2>&1 &
checking=$!
# A process more than there are cores, as tests also wait for programs that they start; one thread in each is enough.
# Tests of one file share what it sets up, and the slowest files begin first (tests/slow.txt). Modules are compiled once,
# not in each of the processes that tests start.
unset PYTHONDONTWRITEBYTECODE
processes=$(($(env -u OMP_NUM_THREADS nproc) + 1))
OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 .venv/bin/python -m pytest --numprocesses "$processes" --dist loadfile \
  --no-loadscope-reorder "$@" && tested=0 || tested=$?
wait "$checking" && typed=0 || typed=$?
cat "$types/found.txt"
exit $((tested ? tested : typed))
