"""Wrong inputs that `kinefit track` names, and alarms that it gives about right ones. `python -m benchmarks faults`.

Faults are made in real recordings. Thresholds were chosen on the balancing trial, and those of lens distortion on the
seated person; the others were looked at afterwards.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

from benchmarks.commands import QUIET, invoked
from benchmarks.figures import amount, figure, quick
from benchmarks.robustness.faulty_inputs import Fault, faults
from benchmarks.robustness.faulty_recordings import Inputs, recordings, right_takes

FEW = ("translations times 1.8", "left and right exchanged", "the x of a translation negated")


def told(take: Path) -> list[str] | None:
    """The faults on top of what `kinefit track` says of a take, or of why it cannot track it; None where it cannot."""
    result = invoked("track", take, "--out", take.parent / "out", *QUIET)
    if result.exit_code == 0:
        top = result.stdout.partition("\nsensor ")[0].partition("\nnote: ")[0]
        return [block.strip() for block in re.split(r"\n(?=fault: )", top) if block.strip().startswith("fault: ")]
    cause = [block for block in result.output.split("\n\n") if "the inputs have a fault" in block]
    return cause or None


def is_named(fault: Fault, inputs: Inputs, found: list[str], usual: list[str]) -> bool:
    """Whether a fault is named, with its camera, and no other camera is blamed that is not with the right files."""
    names = inputs.rig.names
    mine = [block for block in found if re.search(fault.says, block)]
    if fault.camera is None:
        return bool(mine)
    right = names[fault.camera]
    blamed = {n for block in found for n in names if f"fault: {n}" in block or f": {n} has moved" in block}
    known = {n for block in usual for n in names if f"fault: {n}" in block}
    return any(right in block for block in mine) and not blamed - known - {right}


def run() -> None:
    """Print the figures."""
    missed: dict[str, list[str]] = {}
    alarms, clean = 0, 0
    with tempfile.TemporaryDirectory() as where:
        for inputs in recordings(Path(where)):
            usual = told(inputs.write(Path(where) / inputs.name / "right")) or []
            clean, alarms = clean + 1, alarms + bool([b for b in usual if not inputs.is_off or "bias" not in b])
            for name, fault in faults(inputs):
                if quick() and (name not in FEW or inputs.name != "balancing"):
                    continue
                slug = name.replace(" ", "_")
                found = told(fault.make(inputs).write(Path(where) / inputs.name / slug)) or []
                named = is_named(fault, inputs, found, usual)
                missed.setdefault(name, []).extend([] if named else [inputs.name])
                said = " | ".join(block.strip().splitlines()[0] for block in found)
                print(f"# {inputs.name}, {name}: {'named' if named else 'MISSED'}: {said or 'nothing'}", flush=True)
        for name, take in () if quick() else right_takes(Path(where)):
            faults_told = told(take)
            clean, alarms = clean + (faults_told is not None), alarms + bool(faults_told)
            said = "cannot be tracked" if faults_told is None else " ".join(faults_told) or "nothing"
            print(f"# {name}, right files: {said}", flush=True)
    named = sum(not recordings_missed for recordings_missed in missed.values())
    figure("faults_inputs_named", float(named), f"of {len(missed)}", f"== {amount(15, len(FEW))}")
    figure("faults_inputs_false_alarms", float(alarms), f"of {clean} recordings with right files", "== 0")
