"""Diagnosis, validation, report."""
