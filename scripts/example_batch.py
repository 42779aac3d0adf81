"""Reconstruct every capture in a folder, and list the scales, the least certain one first.

    python scripts/example_batch.py FOLDER OUT [--config options.toml] [--scheduler tcp://host:8786]

Started again, it continues. With a scheduler, the workers of a Dask cluster do the work.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from colmap_inertial import (
    BatchCapture,
    BatchOptions,
    CaptureStatus,
    InertialError,
    ReconstructOptions,
    load_capture,
    read_config,
    run_batch,
)


def options_for(folder: Path, options: ReconstructOptions) -> ReconstructOptions:
    """Options by what a capture is: where the camera is not known, every pair helps COLMAP to calibrate it."""
    try:
        known = load_capture(folder).camera is not None
    except InertialError:  # the batch reports what is wrong with it
        return options
    return options if known else replace(options, mapping=replace(options.mapping, pairing="exhaustive"))


def watch(status: CaptureStatus) -> None:
    """Called whenever something changed."""
    if status.state == "running":
        print(f"{status.name}: {status.stage} {status.steps_done}/{status.steps} on {status.host}")
    elif status.finished:
        print(f"{status.name}: {status.state}{'' if status.error is None else ', ' + status.error}")


def main() -> None:
    """Run the batch; exits with 1 where a capture failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--scheduler")
    args = parser.parse_args()
    options = ReconstructOptions() if args.config is None else read_config(args.config, ReconstructOptions)
    folders = sorted(path.parent for path in args.folder.glob("*/capture.toml"))
    captures = [BatchCapture(name=folder.name, path=folder, options=options_for(folder, options)) for folder in folders]
    result = run_batch(captures, args.out, batch=BatchOptions(scheduler=args.scheduler), watch=watch)

    models = [(capture.name, model) for capture in result.captures for model in capture.models if model["ci95"]]
    for name, model in sorted(models, key=lambda item: item[1]["ci95"][0] / item[1]["ci95"][1]):
        low, high = model["ci95"]
        print(f"{name} model {model['index']}: {low:.5g} to {high:.5g} m per unit, {model['verdict']}")
    raise SystemExit(result.exit_code())


if __name__ == "__main__":
    main()
