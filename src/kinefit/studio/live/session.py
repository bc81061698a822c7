"""A live session: fit the frames of all sources as they arrive, and send each pose to all receivers."""

from __future__ import annotations

import contextlib
import gc
import queue
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import msgspec
import numpy as np

from kinefit.bodies import Body, catalogue, load_body
from kinefit.errors import BodyError, KinefitError, ObservationError, check_choice, choices
from kinefit.exporters.motion_file import hello
from kinefit.fitting import FrameResult, Tracker
from kinefit.fitting.tracking.motions import axis_of
from kinefit.observations import Keypoints
from kinefit.studio.live.cameras import Arrived, Inbox, LiveDetector
from kinefit.studio.live.folders import REPLAY
from kinefit.studio.live.packets import Answer, ClientRequest, PosePacket, read_request
from kinefit.studio.live.people import LivePerson, LiveSize
from kinefit.studio.live.record import SeenRecord

_MAX_LATENCIES = 10_000  # that are stored
_PATIENCE_WITHOUT_DROPS_S = 10.0  # wait for the other sensors, if no frame may be dropped
_MAX_WAIT_S = 0.25  # between two checks of the clients' requests
_MAX_WAITING_REQUESTS = 64  # of all clients: two seconds, at one a step


class Source(Protocol):
    """Puts frames into an inbox, from its own thread."""

    sensors: tuple[str, ...]
    patient: bool  # whether it waits for a free slot, so that no frame is dropped

    def start(self, inbox: Inbox) -> None:
        """Start putting frames into the inbox."""

    def stop(self) -> None:
        """Stop putting frames into the inbox."""


class Receiver(Protocol):
    """Receives poses; its methods must return at once."""

    def hello(self, body: Body, packet: bytes) -> None:
        """Handle a new body, with its packet."""

    def pose(self, posed: PosePacket, packet: bytes) -> None:
        """Handle a pose, with its packet."""

    def close(self) -> None:
        """Handle the end of the session."""


class LiveSession:
    """Tracks one person in the frames of live sources.

    Parameters
    ----------
    tracker : Tracker
    sources : of frames
    receivers : of poses
    detector : for sources of images
    person : choice of the tracked person; default: the one with most visible points
    size : fit of the person's lengths in the first seconds; None if they are known
    seen : record of the person's detections
    name : str of the session

    Attributes
    ----------
    inbox : Inbox
    processed, found : int, number of steps, and of those in which the person was found
    latencies : [s] of the latest steps, from the arrival of the newest frame until all receivers have the pose
    requests : queue of clients' requests, see `ask`
    """

    def __init__(
        self, tracker: Tracker, sources: Sequence[Source], receivers: Sequence[Receiver] = (), *,
        detector: LiveDetector | None = None, person: LivePerson | None = None, size: LiveSize | None = None,
        seen: SeenRecord | None = None, name: str = "live",
    ) -> None:  # fmt: skip
        self.tracker, self.sources, self.receivers = tracker, tuple(sources), tuple(receivers)
        self.detector, self.size, self.seen, self.name = detector, size, seen, name
        self.person = person or LivePerson(tracker.rig)
        self.sensors = tuple(sensor for source in self.sources for sensor in source.sensors)
        patience = _PATIENCE_WITHOUT_DROPS_S if any(source.patient for source in self.sources) else 0.5 / tracker.rate
        self.inbox = Inbox(self.sensors, patience=patience)
        self.processed = self.found = 0
        self.latencies: deque[float] = deque(maxlen=_MAX_LATENCIES)
        self.requests: queue.Queue[tuple[ClientRequest, Answer]] = queue.Queue(_MAX_WAITING_REQUESTS)
        self._replaced: tuple[Body, ClientRequest, Answer] | None = None  # until a step is fitted with that body
        self._off: set[str] = set()
        self._choices = 0  # of another person
        self._paused = self._over = False

    @property
    def names(self) -> list[str]:
        """Sensors that a client may disable or weigh: cameras, and named sensors of the sources."""
        return sorted({*self.sensors, *self.tracker.rig.names} - {REPLAY})

    def stop(self) -> None:
        """End the session after the current step."""
        self._over = True

    def run(self, seconds: float | None = None) -> None:
        """Run until the sources end, `stop` is called, or after a time [s].

        Raises
        ------
        KinefitError
            A failed source, or frames that do not match the body or its cameras.
        """
        until = None if seconds is None else time.monotonic() + seconds
        self._hello()
        gc.collect()
        gc.freeze()  # existing objects live as long as the session: repeated collection would delay poses
        try:
            for source in self.sources:
                source.start(self.inbox)
            while not (self._over or self.inbox.over) and (until is None or time.monotonic() < until):
                arrived = self.inbox.take(_MAX_WAIT_S)
                self._listen()
                if arrived:
                    self.step(arrived)
        finally:
            gc.unfreeze()
            self.close()

    def close(self) -> None:
        """End sources and receivers."""
        self.inbox.close()
        for source in self.sources:
            source.stop()
        if self.size is not None:
            self.size.close()
        if self.detector is not None:
            self.detector.close()
        for receiver in self.receivers:
            receiver.close()
        if self.seen is not None:
            self.seen.close()

    def step(self, arrived: Sequence[Arrived]) -> FrameResult | None:
        """Fit the arrived frames, and send the pose to all receivers."""
        frames, result = ([], None) if self._paused else self._fit(*self._sort(arrived))
        if self.seen is not None:
            self.seen.keep(frames)
        at = max(frame.at for frame in arrived)
        now = result.time if result is not None else max(frame.time for frame in arrived)
        poses = np.zeros((0, 4, 4))
        if result is not None:
            state = result.state
            poses = self.tracker.body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0]
        posed = PosePacket(
            self.processed, self.tracker.body, result, poses, now, time.monotonic() - at, self.inbox.dropped,
            self.inbox.silent(), self._paused, self.person.count, self.person.number, self.person.camera, self._choices,
        )  # fmt: skip
        self.processed, self.found = self.processed + (not self._paused), self.found + (result is not None)
        packet = posed.to_json()
        for receiver in self.receivers:
            receiver.pose(posed, packet)
        if not self._paused:
            self.latencies.append(time.monotonic() - at)
        if self.size is not None and (body := self.size.after(frames, result)) is not None:
            self.change_body(body)
        return result

    def ask(self, request: bytes | Mapping[str, Any], answer: Answer = lambda content: None) -> None:
        """Request a change before one of the next steps; callable from any thread.

        Parameters
        ----------
        request : as JSON or as a mapping
            {"sensor": name, "use": bool}: whether to use a sensor; {"sensor": name, "sigma": value}: its standard
            deviation [px, m]; {"body": name}: another body of the catalogue; {"person": number}: track another person,
            and record that person alone; {"pause": true or false}; {"stop": true}.
        answer : called with {"type": "done"} or {"type": "refused", "why": text}, with the request as "asked"
        """
        try:
            self.requests.put_nowait((read_request(request), answer))
        except KinefitError as error:
            answer({"type": "refused", "why": str(error)})
        except queue.Full:
            answer({"type": "refused", "why": f"{_MAX_WAITING_REQUESTS} requests are waiting. Send it again later."})

    def change_body(self, body: Body) -> None:
        """Continue with another body.

        Raises
        ------
        KinefitError
            From a receiver that does not support it: the session continues with the previous body.
        """
        before = self.tracker.body
        self.tracker.change_body(body)
        try:
            self._hello()
        except KinefitError:
            self.tracker.change_body(before)
            self._hello()
            raise

    def _fit(self, frames: list[Any], records: list[Keypoints]) -> tuple[list[Any], FrameResult | None]:
        """Fit one person's frames; restores the previous body if they do not fit the one that a client requested."""
        try:
            of_person, result = self._track(frames, records)
        except KinefitError as error:
            if self._replaced is None:
                raise
            (before, request, answer), self._replaced = self._replaced, None
            answer(_refused(request, error))
            self.change_body(before)
            return self._track(frames, records)
        if of_person:
            self._replaced = None
        return of_person, result

    def _track(self, frames: list[Any], records: list[Keypoints]) -> tuple[list[Any], FrameResult | None]:
        """Add the tracked person's keypoints to the frames, and fit them; returns both."""
        frames = frames + self.person.frames(records, self.tracker.body, self.tracker.state)
        return frames, self.tracker.update(frames, float(np.mean([f.time for f in frames]))) if frames else None

    def _hello(self) -> None:
        t = self.tracker
        packet = hello(t.body, name=self.name, rate=t.rate, up=axis_of(t.up), sensors=self.names)
        for receiver in self.receivers:
            receiver.hello(t.body, packet)

    def _sort(self, arrived: Sequence[Arrived]) -> tuple[list[Any], list[Keypoints]]:
        """Frames for the tracker, and keypoints of all people."""
        images = [a for a in arrived if isinstance(a.seen, np.ndarray) and a.sensor not in self._off]
        records = self.detector(images) if self.detector is not None and images else []
        frames: list[Any] = []
        for frame in arrived:
            for seen in frame.seen if isinstance(frame.seen, list) else ():
                if isinstance(seen, Keypoints):
                    records += [seen] if seen.camera not in self._off else []
                elif seen.sensor not in self._off:
                    frames.append(seen)
        return frames, records

    def _listen(self) -> None:
        """Fulfil one request of a client: more would delay poses."""
        with contextlib.suppress(queue.Empty):
            request, answer = self.requests.get_nowait()
            try:
                self._fulfil(request, answer)
            except KinefitError as error:
                answer(_refused(request, error))
            else:
                answer({"type": "done", "asked": msgspec.to_builtins(request)})

    def _choose(self, number: int) -> None:
        """Track another person, with files and size of that person alone."""
        if number != self.person.number:
            self.person.choose(number)
            self._choices += 1
            self.tracker.start_over()
            for part in (self.seen, self.size):
                if part is not None:
                    part.restart()

    def _fulfil(self, request: ClientRequest, answer: Answer) -> None:
        if request.stop:
            self.stop()
        elif request.pause is not None:
            self._paused = request.pause
        elif request.person is not None:
            self._choose(request.person)
        elif request.body is not None:
            check_choice("body of the catalogue", request.body, catalogue(), BodyError)
            before = self._replaced[0] if self._replaced else self.tracker.body
            self.change_body(load_body(request.body))
            self._replaced = before, request, answer
        elif request.sensor not in self.names:
            raise ObservationError(choices("sensor", str(request.sensor), self.names))
        elif request.sigma is not None:
            self.tracker.set_sigma(request.sensor, request.sigma)
        else:
            (self._off.discard if request.use else self._off.add)(request.sensor)


def _refused(request: ClientRequest, error: KinefitError) -> dict[str, Any]:
    return {"type": "refused", "asked": msgspec.to_builtins(request), "why": str(error)}
