"""Small recordings for the viewer: videos, and a take with a motion."""

from fractions import Fraction

import av
import numpy as np

from kinefit.exporters import write_motion
from kinefit.readers.calibration.read import write_calibration
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave, studio_rig

RATE = 30


def write_video(path, frames, size=(96, 128)):
    """A lossless grey video, each frame lighter than the last, with a bright spot that wanders."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=Fraction(RATE))
        stream.width, stream.height, stream.pix_fmt = *size, "bgr0"
        for i in range(frames):
            image = np.full((size[1], size[0], 3), 20 + 5 * (i % 40), np.uint8)
            image[10 + 2 * i : 16 + 2 * i, 20:26] = 250
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return path


def write_take(folder, frames=6):
    """take.toml with two cameras, their videos and keypoints; results in take-kinefit. Returns the motion."""
    whole = squat_and_wave()
    motion = cut(whole, 0, frames)
    rig = studio_rig(whole, size=(96, 128)).select(studio_rig(whole).names[:2])
    write_calibration(rig, folder / "calibration.toml")
    lines = [f'[take]\nname = "{motion.name}"\nrate = {motion.rate}\nup = "{motion.up}"']
    lines.append('[calibration]\nfile = "calibration.toml"')
    for camera, seen in zip(rig, simulate_keypoints(motion, rig, "MEDIAPIPE_33", noise_px=0.1, seed=0)):
        data = np.concatenate([seen.points[:, 0], seen.confidence[:, 0, :, None]], axis=2)
        np.save(folder / f"{camera.name}.npy", np.nan_to_num(data))
        lines.append(f'[[camera]]\nname = "{camera.name}"')
        lines.append(f'[[keypoints]]\ncamera = "{camera.name}"\nfile = "{camera.name}.npy"\nformat = "mediapipe"')
    (folder / "take.toml").write_text("\n".join(lines) + "\n")
    write_motion(motion, folder / "take-kinefit" / "motion.npz")
    return motion
