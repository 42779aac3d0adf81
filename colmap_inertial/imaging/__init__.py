"""Images before feature extraction: blur fields, deconvolution, rolling shutter."""
