"""Runs and measures a command: `python -I -S launch.py LIMIT ERRORS COMMAND …` prints one line of JSON.

This is a separate, small process that forks, because `ru_maxrss` includes the memory of the process before `exec`.
Prints the wall time in s, the largest resident set of any process of the tree in kB, the exit status, and whether the
command was killed after LIMIT seconds.
"""

import contextlib
import os
import signal
import sys
import time

limit, errors, command = float(sys.argv[1]), sys.argv[2], sys.argv[3:]
late = False


def stop(_signal, _frame):
    global late
    late = True
    with contextlib.suppress(ProcessLookupError):  # it has just ended
        os.killpg(child, signal.SIGKILL)


signal.signal(signal.SIGALRM, stop)
sink = os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
null = os.open(os.devnull, os.O_RDWR)
begin = time.perf_counter()
child = os.fork()
if child == 0:
    try:
        os.setpgid(0, 0)
        for descriptor, file in enumerate((null, null, sink)):
            os.dup2(file, descriptor)
        os.execvp(command[0], command)
    except OSError as error:
        os.write(2, f"{command[0]}: {error}".encode())
    os._exit(127)
signal.setitimer(signal.ITIMER_REAL, limit)
_, status, usage = os.wait4(child, 0)
wall = time.perf_counter() - begin
signal.setitimer(signal.ITIMER_REAL, 0)
code = os.waitstatus_to_exitcode(status)
print(f'{{"wall": {wall}, "kb": {usage.ru_maxrss}, "status": {code}, "late": {str(late).lower()}}}')
