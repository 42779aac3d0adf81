"""The hooks: what happens to frames, keypoints and models, each stage behind the same door as a visitor's."""
