"""People among each other, simulated with truth: exchanges, joint errors and time, through `track`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.accuracy.people.people_crowds import KINDS, Crowd, crowd
from benchmarks.figures import amount, figure, quick
from benchmarks.timing import timed
from kinefit import Motion, load_body
from kinefit.fitting.multiview.followed import PersonKeypoints, follow
from kinefit.fitting.multiview.people import PersonTrack, people_of
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.video import track

SEEDS = amount(tuple(range(10, 14)), (10,))  # of each kind of scene: twenty sequences; 0 to 3 found two faults
_LIMBS = ("upperarm", "forearm", "thigh", "shank")
_ON = 0.3  # [m] median distance of a body's joints from those of the person on whom it stands


def run() -> None:
    """Print every figure."""
    exchanged, lost, wrong, errors, right = 0, 0, 0, [], []
    taken, given = 0, 0
    sequences = [(kind, seed) for seed in SEEDS for kind in KINDS]
    for kind, seed in sequences[:2] if quick() else sequences:
        seen = crowd(kind, seed, amount(150, 45))
        people = people_of(seen.rig, seen.keypoints)
        whose = [owners_of(seen.order, one.chosen) for one in people]
        others = [(w >= 0) & (w != np.bincount(w[w >= 0]).argmax()) for w in whose]
        exchanged += sum(int(np.any(2 * o.sum(axis=0) > (w >= 0).sum(axis=0))) for o, w in zip(others, whose))
        mixed = sum(int(o.sum()) for o in others)
        taken, given = taken + mixed, given + sum(int((w >= 0).sum()) for w in whose)
        lost += max(len(seen.motions) - len(people), 0)
        wrong += max(len(people) - len(seen.motions), 0)
        motions = [motion_of(seen, people, k) for k in range(len(people))]
        owners = [int(np.bincount(w[w >= 0]).argmax()) for w in whose]
        told = [errors_of(seen, motion, owner) for motion, owner in zip(motions, owners)]
        errors += [e for e, _ in told]
        right += [r for _, r in told]
        print(
            f"# {kind} {seed}: {len(seen.motions)} people, {len(seen.rig)} cameras: found {len(people)}, "
            f"{mixed} views with another's detection; joints {', '.join(f'{e:.1f}' for e, _ in told)} mm, "
            f"PCP {', '.join(f'{100 * r:.1f}' for _, r in told)} %", flush=True,
        )  # fmt: skip
    figure("people_exchanges", float(exchanged), "people who are another in most views of some frame", "<= 0")
    print(f"# {taken} of {given} views have another's detection")
    figure("people_lost", float(lost), "people", "<= 0")
    figure("people_invented", float(wrong), "people", "<= 0")
    figure("people_joints", float(np.mean(errors)), "mm", "<= 10")
    figure("people_pcp", 100 * float(np.mean(right)), "%", ">= 98")
    _speed()


def owners_of(orders: Sequence[np.ndarray], chosen: Sequence[np.ndarray]) -> np.ndarray:
    """(C, F) whose detections somebody has, -1 for none."""
    out = []
    for mine, order in zip(chosen, orders):
        match = (order == mine[:, None]) & (mine[:, None] >= 0)
        out.append(np.where(match.any(axis=1), match.argmax(axis=1), -1))
    return np.array(out)


def motion_of(seen: Crowd, people: Sequence[PersonTrack], k: int) -> Motion:
    """One of the people, smoothed, as by the command."""
    recording = Recording.of_keypoints(seen.rig, seen.keypoints, sigma=4.0, person=k + 1, people=people, up="y")
    return track(recording, load_body("humanoid"))


def errors_of(seen: Crowd, motion: Motion, owner: int) -> tuple[float, float]:
    """[mm] mean distance of joints and share of limbs found while the person is there."""
    truth, there = seen.motions[owner], seen.there[:, owner]
    a, b = (m.segment_poses()[there][..., :3, 3] for m in (motion, truth))
    tree = truth.body.tree
    far = np.linalg.norm(a - b, axis=-1)
    good = []
    for child, parent in enumerate(tree.parents):
        if parent >= 0 and any(tree.segments[parent].startswith(name) for name in _LIMBS):
            length = np.linalg.norm(b[:, child] - b[:, parent], axis=-1)
            good.append((far[:, child] + far[:, parent]) / 2 <= 0.5 * length)
    return 1e3 * float(far.mean()), float(np.mean(good))


def frames_on_one(seen: Crowd, motions: Sequence[Motion]) -> int:
    """Frames in which two tracked bodies stand on one true person: within 0.3 m (median joint), nobody else nearer."""
    joints, truth = (np.array([m.joint_centres for m in several]) for several in (motions, seen.motions))
    away = np.median(np.linalg.norm(joints[:, None] - truth, axis=-1), axis=-1)  # (bodies, people, F) [m]
    nearest = np.where(seen.there.T, away, np.inf).argmin(axis=1)
    on = (away.min(axis=1) < _ON) & (np.array([m.quality for m in motions]) > 0)
    counts = [np.sum((nearest == person) & on, axis=0) for person in range(len(truth))]
    return int(np.any(np.array(counts) > 1, axis=0).sum())


def _speed() -> None:
    """Association and tracking, CPU time of one core, of two and of five people."""
    spent = {}
    for kind, count in (("cross", 2), ("crowd", 5)):
        seen = crowd(kind, 0, amount(150, 45))
        times = []
        for _ in range(amount(3, 1)):
            with timed(times):
                people = people_of(seen.rig, seen.keypoints)
                for k in range(len(people)):
                    one = follow(seen.rig, seen.keypoints, k + 1, people)  # who is who is found once, as by the command
                    alone = _alone(seen, one, k)
                    track(alone, load_body("humanoid"), smooth=False)
        spent[count] = min(times) / len(seen.keypoints[0])
        print(f"# {count} people, {len(seen.rig)} cameras: {1 / spent[count]:.0f} frames/s, all but smoothing")
    figure("people_speed_two", 1 / spent[2], "frames/s", ">= 100")
    figure("people_cost_power", float(np.log(spent[5] / spent[2]) / np.log(2.5)), "power of people", "<= 1.15")


def _alone(seen: Crowd, one: PersonKeypoints, k: int) -> Recording:
    """One person's recording, with nobody sought anew."""
    records = [r.of_one(chosen) for r, chosen in zip(seen.keypoints, one.people[k].chosen)]
    return Recording.of_keypoints(seen.rig, records, sigma=4.0, up="y")
