"""Clients of a service. They send the requests of the operations in ``_session`` and wait."""

import asyncio
import concurrent.futures
import itertools
import threading
import time

import httpx

from ._messages import MapResult, Pause, Response
from ._methods import ClientMethods, JobMethods
from ._molmesh import __version__

__all__ = ["AsyncClient", "AsyncJob", "Client", "Job", "MapResult"]

# Longest time to connect, s.
CONNECT_TIMEOUT = 10.0


def client_options(session):
    return {
        "base_url": session.url,
        "headers": {"User-Agent": f"molmesh-python/{__version__}", **session.headers},
        # The service limits the connections of its clients.
        "limits": httpx.Limits(max_connections=None, max_keepalive_connections=None),
    }


def stream_arguments(request):
    """Returns the arguments of ``httpx.Client.stream()``."""
    timeout = httpx.Timeout(request.timeout, connect=min(request.timeout, CONNECT_TIMEOUT))
    query = {"params": request.query} if request.query else {}
    names = {"method": request.method, "url": request.path, "headers": request.headers, "timeout": timeout}
    return {**names, **query, **request.body}


def is_kept_in_memory(request, response):
    """Returns true if the content is returned instead of written to the output file."""
    return request.output is None or request.output.path is None or response.status_code != 200


def transport_error(session, error):
    """Returns the exception of a request without a response."""
    kind = TimeoutError if isinstance(error, httpx.TimeoutException) else ConnectionError
    return kind(f"no response from {session.url}: {error or type(error).__name__}")


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


class Client(ClientMethods):
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

    _job_type = Job

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
        try:
            step = next(steps)
            while stop is None or not stop.is_set():
                try:
                    if isinstance(step, Pause):
                        answer = time.sleep(step.seconds) if stop is None else stop.wait(step.seconds)
                    else:
                        answer = self._send(step)
                except Exception as error:
                    step = steps.throw(error)
                else:
                    step = steps.send(answer)
        except StopIteration as end:
            return end.value
        finally:
            steps.close()

    def _send(self, request):
        """Sends a request."""
        try:
            with self._http.stream(**stream_arguments(request)) as response:
                content = b""
                if is_kept_in_memory(request, response):
                    content = response.read()
                else:
                    file = request.output.restart()
                    for piece in response.iter_bytes():
                        file.write(piece)
                return Response(response.status_code, response.headers, content)
        except httpx.HTTPError as error:
            raise transport_error(self._session, error) from error

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


class AsyncClient(ClientMethods):
    """Client of a service of molmesh for asyncio. Its methods are those of ``Client`` as coroutines.

    ``map()`` returns an asynchronous iterator, and ``job()`` the job. Files are read and written without a thread.

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

    _job_type = AsyncJob

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
        try:
            step = next(steps)
            while True:
                try:
                    if isinstance(step, Pause):
                        answer = await asyncio.sleep(step.seconds)
                    else:
                        answer = await self._send(step)
                except Exception as error:
                    step = steps.throw(error)
                else:
                    step = steps.send(answer)
        except StopIteration as end:
            return end.value
        finally:
            steps.close()

    async def _send(self, request):
        """Sends a request."""
        try:
            async with self._http.stream(**stream_arguments(request)) as response:
                content = b""
                if is_kept_in_memory(request, response):
                    content = await response.aread()
                else:
                    file = request.output.restart()
                    async for piece in response.aiter_bytes():
                        file.write(piece)
                return Response(response.status_code, response.headers, content)
        except httpx.HTTPError as error:
            raise transport_error(self._session, error) from error

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
for item in (AsyncClient, AsyncJob, Client, Job, MapResult):
    item.__module__ = "molmesh"
