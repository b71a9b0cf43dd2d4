#!/usr/bin/env python3
"""Simulates a cluster: how many workers a load needs, and what queue and store must bear.

    python3 benches/load/cluster_simulation.py --jobs-per-second 1000 --seconds-per-job 0.5

Jobs arrive at random (Poisson) and take a random time (log-normal, as structures differ in size). Workers claim them
one after another from one broker, which serves a limited number of claims per second. A job of a worker that fails runs
again after the lease. The constants below were measured with the scripts and tests that their comments name. The script
prints the smallest number of workers for which the 99th percentile of the waiting time stays below a limit, and the
load on queue and store.
"""

import argparse
import heapq
import math
import random

# Claims per second of one NATS server (test `jobs_are_dispatched_and_claimed_concurrently`).
CLAIMS_PER_SECOND = 5_000
# Requests of one job to an S3 store (`benches/load/store_requests.py`).
WRITES_PER_JOB, READS_PER_JOB = 6, 20
# Messages of one job to NATS, without the answers and copies: dispatch, two announcements, a request, lock, release of
# the lock, acknowledgement, and four events.
MESSAGES_PER_JOB = 11
# Time of a job beside its mesh: requests to queue and store, s.
OVERHEAD = 0.05
# Standard deviation of the logarithm of the time of a job.
SPREAD = 1.0


def waiting_times(workers, rate, mean, lease, failures, jobs, seed):
    """Returns the sorted waiting times of `jobs` jobs, s. `failures` is the rate of failures of one worker, 1/s."""
    dice = random.Random(seed)
    scale = math.log(mean) - SPREAD**2 / 2
    free = [0.0] * workers
    heapq.heapify(free)
    broker, now, waits = 0.0, 0.0, []
    for _ in range(jobs):
        now += dice.expovariate(rate)
        begin = max(now, free[0], broker)
        broker = begin + 1 / CLAIMS_PER_SECOND
        waits.append(begin - now)
        time = OVERHEAD + dice.lognormvariate(scale, SPREAD)
        # A worker that fails during the job is replaced after the lease, and the job runs again.
        if failures and dice.random() < 1 - math.exp(-failures * time):
            time += lease + time
        heapq.heapreplace(free, begin + time)
    return sorted(waits)


def needed(rate, mean, limit, lease, failures, jobs, seed):
    """Returns the smallest number of workers that meets the limit, and the percentiles of the waiting time."""
    low = math.ceil(rate * (mean + OVERHEAD))
    high = 2 * low + 10

    def percentiles(workers):
        waits = waiting_times(workers, rate, mean, lease, failures, jobs, seed)
        return waits[len(waits) // 2], waits[len(waits) * 99 // 100]

    if percentiles(high)[1] > limit:
        return None, percentiles(high)
    while low < high:
        middle = (low + high) // 2
        if percentiles(middle)[1] <= limit:
            high = middle
        else:
            low = middle + 1
    return low, percentiles(low)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--jobs-per-second", type=float, nargs="+", default=[1, 10, 100, 1000, 3000])
    parser.add_argument("--seconds-per-job", type=float, default=0.5)
    parser.add_argument("--wait", type=float, default=2.0, help="limit of the 99th percentile of the waiting time, s")
    parser.add_argument("--lease", type=float, default=30.0)
    parser.add_argument("--worker-hours", type=float, default=24.0, help="mean time between failures of a worker, h")
    parser.add_argument("--dollars-per-worker-hour", type=float, default=0.05)
    parser.add_argument("--dollars-per-million", type=float, nargs=2, default=[5.0, 0.4], help="writes and reads of S3")
    parser.add_argument("--samples", type=int, default=60_000)
    args = parser.parse_args()
    print("| jobs/s | workers | wait p50, s | wait p99, s | NATS messages/s | store writes/s | reads/s | $ per 10^6 meshes |")
    print("|---|---|---|---|---|---|---|---|")
    for rate in args.jobs_per_second:
        failures = 1 / (args.worker_hours * 3600)
        # Long enough for a steady state.
        jobs = max(args.samples, int(100 * rate))
        workers, (half, most) = needed(rate, args.seconds_per_job, args.wait, args.lease, failures, jobs, 1)
        if workers is None:
            print(f"| {rate:g} | the broker is too slow | {half:.2f} | {most:.2f} | | | | |")
            continue
        write, read = args.dollars_per_million
        cost = workers * args.dollars_per_worker_hour / 3600 / rate * 1e6 + WRITES_PER_JOB * write + READS_PER_JOB * read
        loads = [rate * n for n in (MESSAGES_PER_JOB, WRITES_PER_JOB, READS_PER_JOB)]
        print(f"| {rate:g} | {workers} | {half:.2f} | {most:.2f} | " + " | ".join(f"{n:,.0f}" for n in loads) + f" | {cost:.0f} |")


if __name__ == "__main__":
    main()
