"""Run the built-in detector on live images, in parallel over cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from kinefit.geometry.camera import ImageFrame
from kinefit.images.detectors.detection import Follower, PersonDetection
from kinefit.images.detectors.models import Models
from kinefit.live.inbox import Arrived
from kinefit.observations import MEDIAPIPE_33, Keypoints
from kinefit.observations.detections import in_calibration
from kinefit.preparing.detecting import Networks

SET = "MEDIAPIPE_33"


class LiveDetector:
    """Detector of the keypoints of all people in the newest images of some cameras.

    Parameters
    ----------
    networks : files of the networks
    images : {camera: ImageFrame} from the calibration's image to the camera's
    rate : float [Hz] of images, about
    people : largest number of tracked people in each camera
    threads : int, in parallel
    """

    def __init__(
        self, networks: Networks, images: Mapping[str, ImageFrame], *, rate: float, people: int = 1, threads: int = 2
    ) -> None:
        self.images, self.rate = dict(images), rate
        share = max(threads // max(len(self.images), 1), 1)
        self._followers = {
            name: Follower(Models(networks.folder, share, networks.landmarks), rate, people, masks=False)
            for name in self.images
        }
        self._pool = ThreadPoolExecutor(min(threads, max(len(self.images), 1)))
        cv2.setNumThreads(1)

    def __call__(self, arrived: Sequence[Arrived]) -> list[Keypoints]:
        """Records of one frame each, in the order of the images."""
        return list(self._pool.map(self._one, arrived))

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def _one(self, image: Arrived) -> Keypoints:
        return as_keypoints(
            self._followers[image.sensor].update(image.seen), image.sensor, image.time, self.rate,
            self.images[image.sensor],
        )


def as_keypoints(
    seen: Sequence[PersonDetection], camera: str, time: float, rate: float, image: ImageFrame
) -> Keypoints:
    """Keypoints of all people in one image, in the calibration's image frame; time [s], rate [Hz]."""
    count = len(seen), len(MEDIAPIPE_33)
    uv = np.array([s.points for s in seen]).reshape(*count, 2)
    confidence = np.array([s.confidence for s in seen]).reshape(count)
    points, lifted = in_calibration(uv, np.array([s.lifted for s in seen]).reshape(*count, 3), image)
    return Keypoints(
        camera, SET, MEDIAPIPE_33, rate, points[None], confidence[None], time_offset=time,
        lifted=None if lifted is None else lifted[None],
    )  # fmt: skip
