"""Commands in processes of their own, and what they say of their progress."""

import asyncio
import json

import pytest

from kinefit.studio.app.jobs import DONE, FAILED, PAUSED, RUNNING, WAITING, Job, JobQueue, Progress


def ended(queue):
    """Wait until no job of a queue is open, within a minute."""

    async def wait():
        while any(job.is_open for job in queue.jobs):
            await asyncio.sleep(0.02)

    return asyncio.wait_for(wait(), 180.0)


def test_events_are_taken_in(tmp_path):
    job = Job(tmp_path / "take.toml", ("track", "take.toml"))
    job.take_event({"event": "step", "what": "frames", "done": 0, "total": 8})
    job.take_event({"event": "step", "what": "frames", "done": 2, "total": 8})
    job.take_event({"event": "note", "text": "one camera"})
    job.take_event({"event": "error", "problem": "no video", "at": "a.mp4", "try": "Copy it."})
    assert job.steps["frames"].share == 0.25 and job.steps["frames"].seconds_left >= 0.0
    assert job.notes == ["one camera"] and job.error == {"problem": "no video", "at": "a.mp4", "try": "Copy it."}
    for wrong in ({"text": "x"}, ["step"], {"event": "another"}):
        with pytest.raises(ValueError, match="no event"):
            job.take_event(wrong)


def test_time_left_is_the_rest_at_the_speed_so_far():
    assert Progress(done=25, total=100, begun=0.0, changed=5.0).seconds_left == 15.0
    assert Progress(done=0, total=100, begun=0.0, changed=5.0).seconds_left is None
    assert Progress(done=5, total=0, begun=0.0, changed=5.0).seconds_left is None


def test_commands_run_one_after_the_other_and_their_errors_are_kept(tmp_path):
    (tmp_path / "take.toml").write_text("[take\n")

    async def scenario():
        queue = JobQueue()
        first = queue.add(tmp_path / "take.toml", ["check", str(tmp_path / "take.toml"), "--json"])
        second = queue.add(tmp_path / "other.toml", ["check", str(tmp_path / "other.toml"), "--json"])
        assert queue.add(first.take, ["check", "again"]) is first  # asked for twice, done once
        while first.state == WAITING:
            await asyncio.sleep(0.01)
        assert (first.state, second.state) == (RUNNING, WAITING) and queue.open(first.take) is first
        await ended(queue)
        return queue, first, second

    queue, first, second = asyncio.run(scenario())
    assert first.state == second.state == FAILED and queue.open(first.take) is None
    assert "not TOML" in first.error["problem"] and "take.toml" in first.error["at"] and first.error["try"]
    assert second.error["problem"] and queue.of(second.take, "check") is second


def test_a_take_is_tracked_and_one_that_waits_can_be_taken_back(copy_take, tmp_path):
    take = copy_take(tmp_path / "a")
    options = ["--json", "--no-overlays", "--no-report", "--formats", "motion"]

    async def scenario():
        queue = JobQueue()
        job = queue.add(take, ["track", str(take), *options])
        other = queue.add(tmp_path / "b.toml", ["track", str(tmp_path / "b.toml")])
        other.pause()
        await ended(queue)
        return job, other

    job, other = asyncio.run(scenario())
    assert job.state == DONE and other.state == PAUSED, job.error
    assert job.steps["frames"].share == 1.0 and "reading" in job.steps
    (person,) = job.result["people"]
    assert person["frames"] == 60 and (take.with_name("take-kinefit") / "motion.npz").is_file()
    json.dumps(job.result)


def test_a_job_that_is_paused_keeps_what_is_done_and_goes_on(copy_take, tmp_path):
    take = copy_take(tmp_path / "a")
    out = take.with_name("take-kinefit")
    command = ["track", str(take), "--json", "--no-report", "--formats", "motion"]

    async def scenario():
        queue = JobQueue()
        job = queue.add(take, command)
        while job.is_open and "frames" not in job.steps:
            await asyncio.sleep(0.005)
        await queue.close()  # as when the app ends
        again = queue.add(take, command)
        await ended(queue)
        return job, again

    job, again = asyncio.run(scenario())
    assert again.state == DONE and (out / "motion.npz").is_file() and not (out / "unfinished").exists()
    assert job.state in (PAUSED, DONE) and again is not job  # done, where it was quicker than the pause
