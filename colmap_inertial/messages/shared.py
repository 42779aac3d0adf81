"""Sentences that stand under several codes, which differ in their advice."""

from __future__ import annotations


def say_missing(what: str) -> str:
    """A file, folder or anything else that is not there."""
    return f"no such {what}"


def say_existing(path: str) -> str:
    """A path that is not overwritten."""
    return f"{path} exists already"


def say_metric(folder: str, provenance: str = "") -> str:
    """A model that is not scaled twice."""
    return f"{folder} already holds a metric scale{f' ({provenance})' if provenance else ''}"


def say_not_loaded(package: str, detail: str) -> str:
    """A package that is installed, but not usable."""
    return f"{package} cannot be loaded ({detail})"
