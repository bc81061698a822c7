"""Every figure of faults of safety and truth: `python -m benchmarks.faults`; some parts: `... faults faults_live`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "faults_solver": "frames of a long take that a second call of the marker solver lowers",
    "faults_live": "forbidden origins, hosts and wishes before `kinefit live`",
    "faults_folder": "classes that an unfinished folder of results brings in, and kills that it survives",
    "faults_readers": "images that claim much and files that take long: seconds and memory until the error",
    "faults_strangers": "code, files and clocks of strangers in folders of recordings that run, hang or are lost",
    "faults_strangers_window": "attacks on the window in a real browser that succeed",
    "faults_inputs": "takes with wrong files that `kinefit track` names, and false alarms on right ones",
    "faults_users": "files as users have them: what they state is read, or named",
    "faults_users_files": "names, times, masks and depth of files as users have them: right, said and unsaid",
    "faults_cameras": "cameras and clocks that go wrong within a take: right, said, wrong and unsaid",
    "faults_sides": "mirrored worlds and exchanged sides of markers that are named, and false alarms",
}

if __name__ == "__main__":
    run_parts(PARTS)
