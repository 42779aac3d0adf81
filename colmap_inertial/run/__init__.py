"""A run: commands from beginning to end, steps in an output folder, stages of frames, keypoints and models."""
