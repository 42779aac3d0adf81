"""A run: a command from beginning to end, as steps in an output folder.

| package | content |
|---|---|
| `commands` | a module for each command, with its steps in order, and modules for groups of steps |
| `preparation` | what is decided before COLMAP: check, choice of frames, calibration, treatment |
| `stages` | what is done to frames, keypoints and models: the default stages, which are hooks like a user's |
| `steps` | how steps run: each once, whole or not at all, kept by what it depends on |

The steps of ``reconstruct`` (`commands/reconstruct.py`, `_run_steps`), top to bottom. Each reads what it needs from the
files of those before it, so that a run can stop anywhere and go on.

| step | function | writes |
|---|---|---|
| `check` | `preparation.preflight.run_preflight` | ``diagnosis.json`` |
| `selection` | `preparation.selection.run_selection` | ``selection.json`` |
| `imaging` | `preparation.plan.run_plan` | ``imaging.json`` |
| `frames` | `commands.frames.run_frames` | ``colmap/images/``, ``frames.json`` |
| `features`, `matches` | `commands.colmap_steps.run_colmap` | ``colmap/database.db``, ``keypoints.json`` |
| `mapping` | the same | ``colmap/sparse/`` |
| `images` | `commands.frames.run_images` | ``images/`` |
| `metric` | `commands.models.run_models` | ``sparse/``, trajectories |
| `validation_N` | `commands.models.run_validation` | ``validation/`` |
| `georeference` | `commands.georeference.run_georeference` | ``georeference.json`` |
| `dense_N_...` | `commands.dense_steps.run_dense` | ``dense/`` |
| | `commands.reporting.report_result` | ``report.html``, ``result.json`` |

``reconstruct_project`` has `times` (`commands.project_sources.run_times`), `check`, `metric`, `validation_N`,
`georeference`, `apply` (`commands.project_output.place_project`) and `dense_N_...`.

What goes through a run:

- `Session` (`steps.session`): a run at work in its folder; it is made of the next three.
- `Workspace` (`steps.workspace`): where everything lies in the folder, and whose folder it is.
- `StepRunner` (`steps.runner`): runs a step or keeps it, and protects a finished result.
- `RunContext` (`colmap.context`): how the work is done, without the folder: threads, seed, device, progress.
- `Recording` (`io.recording`): capture, IMU, frame times and prior calibration, with what was doubted of them.
- `StageInputs` (`stages.inputs`): what the default stages are made from.
- `Model` (`model`): one of COLMAP's models on its way through the model stages.
- `ScaledModel` (`commands.result`): what these stages found of one; `ModelResult`: the same with what later steps
  measured of it; `ReconstructResult`: all of them, and what ``result.json`` says.

A new step is a function that calls ``session.runner.run(name, depends, outputs, work, after=...)`` and reads back what
``work`` wrote, and a line in `_run_steps`. A new command is a module that opens a session (``open_session``), calls its
steps and ends with ``session.finish``; `commands/images_alone.py` has three.
"""
