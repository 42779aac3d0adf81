"""The faults of ``scripts/mutants.py`` still have their places in the package, and their tests are there."""

import ast
import sys
from pathlib import Path

from cases import loop_over

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts"))
try:
    from mutants import MUTANTS, Outcome, mutated, share_caught
finally:
    sys.path.remove(str(ROOT / "scripts"))


@loop_over("mutant", MUTANTS, ids=lambda m: m.breaks)
def test_a_fault_still_applies_and_names_tests_that_are_there(mutant):
    text = mutated((ROOT / "colmap_inertial" / mutant.file).read_text(encoding="utf-8"), mutant)
    assert text is not None, "stale: what it replaces is not there exactly once"
    ast.parse(text)
    for test in mutant.test_files():
        file, _, name = test.partition("::")
        assert (ROOT / file).is_file()
        assert not name or f"\ndef {name}(" in (ROOT / file).read_text(encoding="utf-8")


def test_faults_differ_and_are_many():
    assert len(MUTANTS) >= 66 and all(one.old != one.new for one in MUTANTS)
    for distinct in ({(one.file, one.old, one.new) for one in MUTANTS}, {one.breaks for one in MUTANTS}):
        assert len(distinct) == len(MUTANTS)


def test_what_survives_without_a_reason_lowers_the_share():
    caught, survived = (Outcome(mutant=MUTANTS[0], state=state) for state in ("caught", "survived"))
    assert share_caught([caught] * 3 + [survived]) == 0.75
