#!/usr/bin/env bash
# Sets everything up and reconstructs the example scene, from images and IMU to metres.
#   demo.sh [OUT]      OUT: a new folder for the result (default: out/desk)
set -euo pipefail
out=$(realpath -m "${1:-$(dirname "$0")/../out/desk}")
cd "$(dirname "$0")/.."
bash scripts/setup.sh
if [ -f "$out/result.json" ]; then
  echo "demo: $out holds the result of an earlier run; remove it to run again"
else
  .venv/bin/colmap-inertial reconstruct example_scenes/desk "$out"
fi
.venv/bin/python scripts/compare_with_truth.py "$out" example_scenes/desk
