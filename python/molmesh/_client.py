"""Clients of a service. They send the requests of the operations in ``_session`` and wait.

Coroutines of `StepClient` perform the operations for both clients. Those of ``Client`` block instead of waiting for an
event loop.
"""

import asyncio
import concurrent.futures
import contextlib
import itertools
import threading
import time
from typing import Any, NamedTuple

import httpx

from ._job_methods import BatchMethods, JobMethods
from ._messages import Item, MapResult, Output, Pause, Read, Response
from ._methods import ClientMethods
from ._molmesh import __version__

__all__ = ["AsyncBatch", "AsyncClient", "AsyncJob", "Batch", "Client", "Job", "MapResult"]

# Longest time to connect, s.
CONNECT_TIMEOUT = 10.0


def client_options(session):
    return {
        "base_url": session.url,
        "headers": {"User-Agent": f"molmesh-python/{__version__}", **session.headers},
        # The service limits the connections of its clients.
        "limits": httpx.Limits(max_connections=None, max_keepalive_connections=None),
    }


def request_arguments(request):
    """Returns the arguments of ``httpx.Client.build_request()``."""
    timeout = httpx.Timeout(request.timeout, connect=min(request.timeout, CONNECT_TIMEOUT))
    query = {"params": request.query} if request.query else {}
    names = {"method": request.method, "url": request.path, "headers": request.headers, "timeout": timeout}
    return {**names, **query, **request.body}


def transport_error(session, error):
    """Returns the exception of a request without a response."""
    kind = TimeoutError if isinstance(error, httpx.TimeoutException) else ConnectionError
    return kind(f"no response from {session.url}: {error or type(error).__name__}")


def complete(coroutine):
    """Runs a coroutine that does not wait for an event loop. Returns its result."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        return end.value
    raise RuntimeError("the operation waits for an event loop")


class Stream(NamedTuple):
    """Response whose content is being received."""

    response: Any
    # Iterator over the content, blocking or asynchronous like the client.
    pieces: Any


class StepClient(ClientMethods):
    """Client that performs operations with ``_pause``, ``_open``, ``_read`` and ``_close`` of a subclass."""

    async def _perform(self, steps, stop=None, streams=None):
        """Performs an operation to its next `Item`, which it returns, or to its end. Ends it without a result if the
        event `stop` is set. The stack `streams` gets the responses that `Read` steps read, and closes them.
        """
        try:
            step = next(steps)
            while stop is None or not stop.is_set():
                if isinstance(step, Item):
                    return step
                try:
                    answer = await self._answer(step, stop, streams)
                except Exception as error:
                    step = steps.throw(error)
                else:
                    step = steps.send(answer)
        except StopIteration as end:
            return end.value

    async def _items(self, steps):
        """Performs an operation and yields its items."""
        async with contextlib.AsyncExitStack() as streams:
            streams.enter_context(contextlib.closing(steps))
            while item := await self._perform(steps, streams=streams):
                yield item.value

    async def _answer(self, step, stop, streams):
        if isinstance(step, Pause):
            return await self._pause(step.seconds, stop)
        try:
            return await (self._read(step.stream) if isinstance(step, Read) else self._send(step, streams))
        except httpx.HTTPError as error:
            raise transport_error(self._session, error) from error

    async def _send(self, request, streams):
        """Sends a request."""
        stream = await self._open(request_arguments(request))
        status, headers = stream.response.status_code, stream.response.headers
        if request.is_stream and status == 200:
            streams.push_async_callback(self._close, stream)
            return Response(status, headers, stream)
        try:
            output = request.output if request.output is not None and status == 200 else Output()
            file = output.restart()
            while piece := await self._read(stream):
                file.write(piece)
            return Response(status, headers, file.getvalue() if output.path is None else b"")
        finally:
            await self._close(stream)


class Job(JobMethods):
    """Asynchronous job of a service, from ``Client.submit()``.

    Examples
    --------
    >>> client = molmesh.Client("http://127.0.0.1:8080")
    >>> job = client.submit("samples/4pti.pdb", surface="ses")
    >>> job.wait(timeout=60)["status"]
    'successful'
    >>> job.result(save="4pti.glb").name
    '4pti.glb'
    """


class AsyncJob(JobMethods):
    """Asynchronous job of a service, from ``AsyncClient.submit()``. Its methods are those of ``Job`` as coroutines."""


class Batch(BatchMethods):
    """Batch of a service, from ``Client.submit_batch()``: one set of parameters for many files.

    Examples
    --------
    >>> client = molmesh.Client("http://127.0.0.1:8080")
    >>> batch = client.submit_batch(["samples/4pti.pdb", "samples/1crn.cif"], outputs=["stl"], resolution=1)
    >>> for name, content in batch.results():
    ...     print(name)
    4pti.stl
    1crn.stl
    summary.jsonl
    """


class AsyncBatch(BatchMethods):
    """Batch of a service, from ``AsyncClient.submit_batch()``. Its methods are those of ``Batch`` as coroutines;
    ``results()`` and ``files()`` return asynchronous iterators.
    """


class Client(StepClient):
    """Client of a service of molmesh. Threads may share it.

    Requests that the service rejects temporarily (424, 429, 502, 503) are retried after the time that it names, and
    after a lost connection if the service has answered before. Proxies and certificates are those of the environment
    (``HTTPS_PROXY``, ``SSL_CERT_FILE``).

    Parameters
    ----------
    url : str
        Address of the service.
    key : str, optional
        API key.
    timeout : float, optional
        Seconds until a request is answered, with all repetitions. Results that arrive may take longer.

    Examples
    --------
    >>> with molmesh.Client("http://127.0.0.1:8080", timeout=60) as client:
    ...     report = client.report("samples/4pti.pdb", surface="vdw")
    >>> report["closed"]
    True
    """

    _job_type, _batch_type = Job, Batch

    def _connect(self):
        """Creates the HTTP client."""
        return httpx.Client(**client_options(self._session))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Closes the connections."""
        self._http.close()

    def _run(self, steps, stop=None):
        """Performs an operation. Ends it without a result if the event `stop` is set."""
        with contextlib.closing(steps):
            return complete(self._perform(steps, stop))

    async def _pause(self, seconds, stop):
        if stop is None:
            time.sleep(seconds)
        else:
            stop.wait(seconds)

    async def _open(self, arguments):
        response = self._http.send(self._http.build_request(**arguments), stream=True)
        return Stream(response, response.iter_bytes())

    async def _read(self, stream):
        return next(stream.pieces, b"")

    async def _close(self, stream):
        stream.response.close()

    def _iterate(self, steps):
        """Performs an operation and yields its items."""
        items = self._items(steps)
        try:
            while (item := complete(anext(items, None))) is not None:
                yield item
        finally:
            complete(items.aclose())

    def _collect(self, steps):
        """Performs an operation and returns its items."""
        return list(self._iterate(steps))

    def _each(self, operations, concurrency):
        """Yields the results of operations as they complete."""
        stop, running, outputs, done = threading.Event(), set(), {}, ()
        try:
            count = concurrency or self._run(self._session.concurrency())
            while True:
                # Before results are passed on, so that the service has work meanwhile.
                for steps, output in itertools.islice(operations, count - len(running)):
                    running.add(future := self._start(steps, stop))
                    outputs[future] = output
                for future in done:
                    del outputs[future]
                    yield future.result()
                if not running:
                    return
                done, running = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
        finally:
            stop.set()
            # The threads may wait for responses until the program ends.
            for output in outputs.values():
                output.discard()

    def _start(self, steps, stop):
        """Performs an operation in a thread. Returns its future."""
        future = concurrent.futures.Future()

        def work():
            try:
                future.set_result(self._run(steps, stop))
            except BaseException as error:
                future.set_exception(error)

        # The end of the program does not wait for requests in progress, unlike with an executor.
        threading.Thread(target=work, name="molmesh", daemon=True).start()
        return future


class AsyncClient(StepClient):
    """Client of a service of molmesh for asyncio. Its methods are those of ``Client`` as coroutines.

    ``map()`` and ``jobs()`` return asynchronous iterators, ``job()`` the job and ``batch()`` the batch. Files are read
    and written without a thread.

    Parameters
    ----------
    url, key, timeout
        As in ``Client``.

    Examples
    --------
    >>> import asyncio
    >>> async def measure(file):
    ...     async with molmesh.AsyncClient("http://127.0.0.1:8080") as client:
    ...         return await client.report(file, surface="vdw")
    >>> asyncio.run(measure("samples/4pti.pdb"))["closed"]
    True
    """

    _job_type, _batch_type = AsyncJob, AsyncBatch

    def _connect(self):
        """Creates the HTTP client."""
        return httpx.AsyncClient(**client_options(self._session))

    async def __aenter__(self):
        return self

    async def __aexit__(self, *_):
        await self.aclose()

    async def aclose(self):
        """Closes the connections."""
        await self._http.aclose()

    async def _run(self, steps):
        """Performs an operation."""
        with contextlib.closing(steps):
            return await self._perform(steps)

    async def _pause(self, seconds, _):
        await asyncio.sleep(seconds)

    async def _open(self, arguments):
        # httpx treats an object with both kinds of iterator as one for the blocking client, and rejects it here.
        if hasattr(arguments.get("content"), "__aiter__"):
            arguments["content"] = aiter(arguments["content"])
        response = await self._http.send(self._http.build_request(**arguments), stream=True)
        return Stream(response, response.aiter_bytes())

    async def _read(self, stream):
        return await anext(stream.pieces, b"")

    async def _close(self, stream):
        await stream.response.aclose()

    _iterate = StepClient._items

    async def _collect(self, steps):
        """Performs an operation and returns its items."""
        return [item async for item in self._items(steps)]

    async def _each(self, operations, concurrency):
        """Yields the results of operations as they complete."""
        running, done = set(), ()
        try:
            count = concurrency or await self._run(self._session.concurrency())
            while True:
                for steps, _ in itertools.islice(operations, count - len(running)):
                    running.add(asyncio.create_task(self._run(steps)))
                for task in done:
                    yield task.result()
                if not running:
                    return
                done, running = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in running:
                task.cancel()


# Documentation and pickles name the module that users import.
for item in (AsyncBatch, AsyncClient, AsyncJob, Batch, Client, Job, MapResult):
    item.__module__ = "molmesh"
