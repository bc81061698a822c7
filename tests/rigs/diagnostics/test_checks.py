"""The engine: every check says what it needs, what it costs and what else would look the same."""

from dataclasses import fields, replace

from kinefit.findings import Edit, Finding, as_records, fixes, in_words, of_provenance
from kinefit.rigs.diagnostics.checks import CHECKS, QUICK_S, Check, Checked, run
from kinefit.takes.check import ALL_CHECKS


def test_every_check_has_its_needs_its_cost_and_what_would_look_the_same():
    known = {field.name for field in fields(Checked)}
    assert len({check.name for check in ALL_CHECKS}) == len(ALL_CHECKS)
    for check in ALL_CHECKS:
        assert set(check.needs) <= known and check.needs and check.cost > 0.0
        assert check.alike.endswith(".") or check.reads or check.name == "keypoints", check.name
    assert {check.name for check in CHECKS if check.cost <= QUICK_S} >= {"scale", "clocks", "gross mistakes", "images"}


def test_checks_run_in_order_as_far_as_they_are_cheap_and_what_they_need_is_there():
    def test(name, sound=True):
        def of(checked):
            checked.sound = sound
            return [Finding("note", name, ""), Finding("doubt", name, "")]

        return of

    checks = (
        Check("a", test("a"), ("keypoints",), 0.1), Check("b", test("b"), ("sound",), 9.0, "C looks the same."),
        Check("c", test("c", sound=False), ("sound",), 0.1, "B looks the same."),
        Check("d", test("d"), ("sound",), 0.1),
    )  # fmt: skip
    whole, quick = run(Checked("take"), checks), run(Checked("take", quick=True), checks)
    assert [f.severity[0] + f.kind for f in whole.findings] == ["db", "dc", "nb", "nc"]
    assert [(f.kind, f.alike) for f in quick.findings] == [("c", "B looks the same."), ("c", "")]


def test_edits_are_the_remedy_and_what_is_a_guess_is_not_fixed():
    late, up = Edit("camera", "time_offset", "0.1", "cam02"), Edit("take", "up", '"y"')
    sure = Finding("fault", "time", "", ("cam02",), "Certain.", edits=(late, up))
    assert sure.remedy == 'Write time_offset = 0.1 into [[camera]] cam02; up = "y" into [take].'
    guess, doubt = replace(sure, confidence="A guess: dark."), replace(sure, severity="doubt")
    assert fixes([sure, sure, guess, doubt]) == (late, up) and fixes([guess, doubt]) == ()
    assert fixes([sure], [replace(up, value='"x"')]) == (late,)  # no key is written twice
    assert in_words([Edit("markers", "turn", None, 1)], " in ") == "no turn in [[markers]] 2"
    assert of_provenance({"findings": as_records([sure])}) == (sure,)
    assert of_provenance({"findings": [{"severity": "fault", "kind": "time", "text": "", "keys": [["a", "1"]]}]})  # 0.2
