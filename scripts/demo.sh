#!/usr/bin/env bash
# Sets up what it needs and reconstructs the example scene, from images and IMU to metres.
#   demo.sh [OUT]      OUT: a new folder for the result (default: out/desk)
set -euo pipefail
out=$(realpath -m "${1:-$(dirname "$0")/../out/desk}")
cd "$(dirname "$0")/.."
echo "demo: step 1 of 3: Python packages into .venv (650 MB on the disk; nothing is done where they are there)"
bash scripts/setup.sh
if [ -f "$out/result.json" ]; then
  echo "demo: step 2 of 3: $out holds the result of an earlier run; remove it to run again"
else
  echo "demo: step 2 of 3: reconstruct example_scenes/desk into $out"
  .venv/bin/colmap-inertial reconstruct example_scenes/desk "$out"
fi
echo "demo: step 3 of 3: compare with the scene's truth"
.venv/bin/python scripts/compare_with_truth.py "$out" example_scenes/desk
printf 'demo: done; the report is %q; look at the model, or measure the board in its images again:\n' "$out/report.html"
program=$(printf %q "$PWD/.venv/bin/colmap-inertial")
if .venv/bin/python -c "import viser" 2> /dev/null; then
  printf '  %s view %q\n' "$program" "$out"
else
  printf '  %s validate %q --images %q --target checkerboard:8x6:0.04\n' "$program" "$out/sparse/0" "$out/images"
fi
