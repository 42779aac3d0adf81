"""What happens to pixels before feature extraction: blur fields, deconvolution, rolling shutter."""
