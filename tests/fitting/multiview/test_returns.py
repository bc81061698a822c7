"""Who leaves and comes back: known again by size, clothes and way, left open where these do not tell."""

import cv2
import numpy as np
import pytest
from tests.fitting.multiview.test_people import BODY, RATE, RIG, SET, owners, records
from tests.oracle import posture

from kinefit.bodies import BodyState
from kinefit.fitting.multiview.followed import PersonKeypoints, sentences
from kinefit.fitting.multiview.people import people_of

BEFORE, GAP, AFTER = 50, 125, 50
FRAMES = BEFORE + GAP + AFTER
AT = [(0.8, 0.0, 0.3), (-0.7, 0.0, 0.2)]


def stay(places, seed, body=BODY):
    """(F, K, 3) [m] keypoints of a person who is at one place before the gap and at another after it."""
    points = body.keypoints(SET)
    out = []
    for f in range(FRAMES):
        state = posture(body, seed, 0.2)
        T = np.array(state.T_world_root)
        T[:3, 3] = places[0] if f < BEFORE + GAP else places[1]
        T[0, 3] += 0.1 * np.sin(f / RATE)
        out.append(body.positions(BodyState(T, state.angles * np.cos(2 * np.pi * f / RATE)), points))
    return np.array(out)


AWAY = [(k, None, BEFORE, BEFORE + GAP) for k in (0, 1)]


def sized(factor):
    """The same person, larger."""
    return BODY.scaled([factor] * len(BODY.scale_groups))


def exchanged(*bodies, seed=0):
    """Two who leave for five seconds and come back each where the other was."""
    people = [stay(AT[::way], 7, body) for body, way in zip(bodies, (1, -1))]
    return people, *records(people, unseen=AWAY, seed=seed)


def painted(people, truth, colours):
    """Pictures of people whose trunk and legs have their colour, in dim light where they come back."""

    def picture(name, frame):
        c = RIG.index(name)
        image = np.full((*RIG[name].size[::-1], 3), 128, np.uint8)
        for k, (points, colour) in enumerate(zip(people, colours)):
            if truth[c][frame, k] >= 0:
                hull = cv2.convexHull(RIG[name].project(points[frame]).astype(np.int32))
                shade = 0.9 if frame >= BEFORE + GAP else 1.0
                cv2.fillConvexPoly(image, hull, tuple(int(shade * v) for v in colour))
        return image, None

    return picture


def each_is_one(found, truth):
    whose = owners(found, truth)
    return len(found) == 2 and sorted(tuple(np.unique(w[w >= 0])) for w in whose) == [(0,), (1,)]


@pytest.mark.parametrize("seed", range(3))
def test_two_of_other_sizes_come_back_exchanged(seed):
    _, keypoints, truth = exchanged(sized(0.92), sized(1.06), seed=seed)
    found = people_of(RIG, keypoints)
    assert each_is_one(found, truth)
    for one in found:
        (back,) = one.returns
        assert abs(back.left - BEFORE) <= 2 and abs(back.came - BEFORE - GAP) <= 2 and back.odds > 10.0


def test_twins_in_the_same_shirt_are_not_guessed():
    people, keypoints, truth = exchanged(BODY, BODY)
    for pictures in (None, painted(people, truth, [(40, 60, 160)] * 2)):
        found = people_of(RIG, keypoints, pictures)
        whose = [np.unique(w[w >= 0]) for w in owners(found, truth)]
        assert all(len(w) == 1 for w in whose) and len(found) == 4
        late = [one for one in found if one.views[:BEFORE].max() == 0]
        assert len(late) == 2 and all(len(one.maybe) == 2 for one in late)
        assert all(found[k].views[:BEFORE].max() > 0 for one in late for k in one.maybe)


def test_twins_in_other_shirts_are_told_by_them():
    people, keypoints, truth = exchanged(BODY, BODY)
    found = people_of(RIG, keypoints, painted(people, truth, [(170, 40, 40), (40, 60, 160)]))
    assert each_is_one(found, truth)


def test_a_stranger_is_not_who_left():
    one, other = (stay([AT[0]] * 2, 7, sized(s)) for s in (0.9, 1.08))
    gone = [(0, None, BEFORE, FRAMES), (1, None, 0, BEFORE + GAP)]
    keypoints, truth = records([one, other], unseen=gone)
    found = people_of(RIG, keypoints)
    assert each_is_one(found, truth) and not any(one.returns or one.maybe for one in found)


@pytest.mark.parametrize("brief", [6, 20])  # frames in which nobody is there, 0.24 and 0.8 s
def test_who_comes_to_the_place_of_another_who_left_is_somebody_else(brief):
    one, other = (stay([AT[0]] * 2, 7, sized(s)) for s in (0.9, 1.08))
    gone = [(0, None, BEFORE, FRAMES), (1, None, 0, BEFORE + brief)]
    keypoints, truth = records([one, other], unseen=gone)
    assert each_is_one(people_of(RIG, keypoints), truth)
    keypoints, truth = records([one], unseen=[(0, None, BEFORE, BEFORE + brief)])
    assert len(people_of(RIG, keypoints)) == 1


def test_nobody_walks_faster_than_people_do():
    for half, count in ((1.5, 1), (2.3, 2)):  # in 1.2 s they go 4.2 m at most
        one = stay([(-half, 0.0, 0.0), (half, 0.0, 0.0)], 7)
        keypoints, _ = records([one], unseen=[(0, None, BEFORE + GAP - 30, BEFORE + GAP)])
        assert len(people_of(RIG, keypoints)) == count


def test_what_is_said_of_those_who_come_back():
    _, keypoints, _ = exchanged(sized(0.92), sized(1.06))
    found = people_of(RIG, keypoints)
    said = sentences(PersonKeypoints(tuple(keypoints), tuple(found), 1, RATE).as_record(), asked=False)
    assert any("leaves at 2.0 s and is re-identified at 7.0 s by size, way (odds " in s for s in said)
    _, keypoints, _ = exchanged(BODY, BODY)
    found = people_of(RIG, keypoints)
    said = sentences(PersonKeypoints(tuple(keypoints), tuple(found), 1, RATE).as_record(), asked=False)
    assert sum("re-identification is undecided" in s for s in said) == 2


def test_what_few_views_took_for_somebody_beside_who_follows_is_left_out():
    from kinefit.fitting.multiview.returns import PresenceSpan, link_spans

    def span(views, x=0.0):
        nodes = {f: [(c, 0) for c in range(n)] for f, n in enumerate(views) if n}
        return PresenceSpan(nodes, {f: np.tile([x, 0.0, 0.0], (3, 1)) + 0.01 * f for f in nodes})

    def views(spans):
        keypoints, _ = records([stay([AT[0]] * 2, 7)])
        chains = link_spans(RIG, keypoints, spans, 3, None)
        return [[len(chain.span.nodes.get(f, ())) for f in range(100)] for chain in chains]

    assert views([span([4] * 50 + [2] * 50), span([0] * 30 + [2] * 20 + [4] * 50)]) == [[4] * 100]
    another = [0] * 80 + [4] * 20  # who comes while the first one is there
    assert views([span([4] * 100), span(another, x=1.0)]) == [[4] * 100, another]
