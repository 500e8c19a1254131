"""One pool of spawned processes for the whole file: starting one takes seconds."""

import os
import time

import pytest

from gns_model.errors import SceneError
from gns_model.workers import WorkerError, Workers, as_completed, report, results
from tests.interrupt import Interrupt


def double(x, slot):
    return 2 * x, os.environ["OMP_NUM_THREADS"], os.getpid()


def half_way(slot):
    report(slot)(0.5)
    time.sleep(1.5)
    return "done"


def refuse(slot):
    raise SceneError("a scene that cannot be")


def die(slot):
    os._exit(1)


@pytest.fixture(scope="module")
def workers():
    with Workers(2) as pool:
        yield pool


def test_jobs_run_in_processes_of_one_thread_and_come_back_by_index(workers):
    jobs = [workers.submit(double, k) for k in range(6)]
    seen = {k: jobs[k].result() for k in as_completed(jobs)}
    assert {k: value[0] for k, value in seen.items()} == {k: 2 * k for k in range(6)}
    assert {value[1] for value in seen.values()} == {"1"}
    assert os.getpid() not in {value[2] for value in seen.values()}


def test_a_job_tells_how_far_it_is(workers):
    job, looks = workers.submit(half_way), []
    for _ in as_completed([job], lambda: looks.append(job.fraction)):
        pass
    assert 0.5 in looks
    assert job.fraction == 1.0
    assert job.result() == "done"


def test_results_come_in_the_order_of_their_jobs_and_tell_how_far_all_of_them_are(workers):
    looks = []
    found = results([workers.submit(half_way), workers.submit(double, 4)], looks.append)
    assert found[0] == "done"
    assert found[1][0] == 8
    assert looks == sorted(looks)
    assert 0.75 in looks, "one done, the other half way"
    assert looks[-1] == 1.0


def test_results_end_with_the_first_job_that_fails(workers):
    jobs = [workers.submit(refuse), *(workers.submit(half_way) for _ in range(4))]
    with pytest.raises(SceneError, match="cannot be"):
        results(jobs)
    assert not all(job.done for job in jobs), "it does not wait for the others"
    list(as_completed(jobs))


def test_a_job_without_a_slot_of_its_own_tells_nothing_before_it_is_done(workers, monkeypatch):
    """More jobs than slots: the rest share one, and would all be as far as any of them."""
    monkeypatch.setattr(workers, "_free", [])
    job, looks = workers.submit(half_way), []
    for _ in as_completed([job], lambda: looks.append(job.fraction)):
        pass
    assert len(looks) > 2
    assert 0.5 not in looks
    assert job.fraction == 1.0
    assert workers._free == []  # the shared one is nobody's to give back


def test_an_error_of_a_job_comes_back_as_it_was(workers):
    with pytest.raises(SceneError, match="cannot be"):
        workers.submit(refuse).result()
    assert workers.submit(double, 1).result()[0] == 2


def test_a_process_that_dies_is_one_clear_error():
    with Workers(1, advice="go home") as pool:
        with pytest.raises(WorkerError, match="go home"):
            pool.submit(die).result()
        with pytest.raises(WorkerError):
            pool.submit(double, 1)


def test_leaving_by_an_interrupt_ends_the_work_at_once():
    def work_and_interrupt():
        with Workers(1) as pool:
            for _ in range(200):
                pool.submit(half_way)
            raise KeyboardInterrupt

    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        work_and_interrupt()
    assert time.monotonic() - started < 60  # and not 200 jobs of 1.5 s


def test_an_interrupt_at_any_line_leaves_the_pool_at_work(workers):
    """It must not take the lock of a future with it, which the pool's own thread needs."""

    def wait_for(job):
        deadline = time.monotonic() + 60

        def watch():
            if time.monotonic() > deadline:
                pytest.fail("the pool no longer works")

        assert list(as_completed([job], watch)) == [0]
        return job.result()

    line, interrupted = 1, True
    while interrupted:
        try:
            with Interrupt(line):
                assert wait_for(workers.submit(double, 1))[0] == 2
            interrupted = False
        except KeyboardInterrupt:
            line += 1
        assert wait_for(workers.submit(double, line))[0] == 2 * line
    assert line > 100
