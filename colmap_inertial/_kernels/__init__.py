"""Compiled kernels. Each has a plain numpy counterpart beside the public function that calls it, which is its truth."""
