"""Limit of the memory of a process: a control group, or the size of the data segment where none can be created."""

import os
import re
import resource
import time

# Mount points of the memory controller, with the files of the limit and of the peak, version 1 first.
MOUNTS = (
    ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.max_usage_in_bytes"),
    ("/sys/fs/cgroup", "memory.max", "memory.peak"),
)


class MemoryGroup:
    """Group of processes that together have at most `limit` bytes. Without permission, `path` is None."""

    def __init__(self, limit):
        self.limit, self.path = limit, None
        for mount, file, peak in MOUNTS:
            path = os.path.join(mount, f"molmesh-attack-{os.getpid()}-{limit >> 20}")
            try:
                os.mkdir(path)
                if os.path.exists(os.path.join(path, file)):
                    write(os.path.join(path, file), limit)
                    self.path, self.peak_file = path, os.path.join(path, peak)
                    return
                os.rmdir(path)
            except OSError:
                continue

    def enter(self):
        """Limits this process. Runs in the child before it executes the program."""
        if self.path:
            write(os.path.join(self.path, "cgroup.procs"), os.getpid())
        else:
            # The allocator reserves 1 GiB at the start, which counts although it is not used.
            resource.setrlimit(resource.RLIMIT_DATA, (self.limit + (1 << 30),) * 2)

    def describe(self):
        return f"control group of {self.limit >> 20} MiB" if self.path else f"data segment of {(self.limit >> 20) + 1024} MiB"

    def remove(self):
        for _ in range(50):
            try:
                if self.path:
                    os.rmdir(self.path)
                return
            except OSError:
                time.sleep(0.1)


def write(path, value):
    with open(path, "w") as file:
        file.write(str(value))


def status(pid):
    """Returns the sizes in `/proc/PID/status` by name, bytes."""
    with open(f"/proc/{pid}/status") as file:
        return {name: int(kib) * 1024 for name, kib in re.findall(r"^(\w+):\s+(\d+) kB$", file.read(), re.M)}
