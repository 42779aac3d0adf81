"""Commands from beginning to end, and the steps that they are made of.

| commands | |
|---|---|
| `reconstruct`, `reconstruct_project` | a capture, or a project that COLMAP made, to metric models |
| `images_alone` | frames treated without a reconstruction |
| `scale`, `scale_by_reference` | the scale of a model, by an IMU or by a target or distance |
| `diagnose`, `validate`, `calibrate_imu` | as they are called |

| steps | of |
|---|---|
| `frames`, `colmap_steps`, `unplaced` | a capture, before and by COLMAP |
| `project_models`, `project_sources`, `project_output` | a project: what is in it, beside it, and comes of it |
| `models`, `model_stages`, `torn_parts` | models: the model stages, and the target |
| `georeference`, `dense_steps` | metric models |
| `result`, `reporting` | what a run found, as values, JSON and page |
"""
