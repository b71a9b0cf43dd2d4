"""Operations of the clients, without input or output.

An operation is a generator. It yields a `Request` and gets its `Response`, yields a `Pause`, or a `Read` and gets the
next piece of a response, and returns the result of the operation. One that has several results yields each as an
`Item`. A request without a response is a `ConnectionError` or a `TimeoutError`, which is thrown into the generator. The
clients only send requests and wait.
"""

import hashlib
import itertools
import json
import math
import os
import pathlib
import random
import re
import secrets
import tarfile
import time
import urllib.parse

from ._batches import ArchiveReader, batch_input, member_path
from ._messages import (
    ENDED,
    Input,
    Item,
    MapResult,
    Output,
    Pause,
    Request,
    batch_path,
    is_spent,
    job_path,
    output_stem,
    parse_areas,
    parse_json,
    parse_problem,
    query_pairs,
    read,
    retry_delay,
    to_exception,
)
from ._molmesh import Error

# Longest time that a request waits for a mesh or a job, s. Proxies commonly cut an exchange after a minute.
LONGEST_WAIT = 20
# Pause between two requests for the status of a job, if the service answers at once, s.
POLL_PAUSE = 1.0
# First and longest pause after a request without a response, s.
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 5.0
# Idempotency keys that follow from a request. Each job that was cancelled, that failed because of the service, or whose
# result is gone uses up one of them; a request beyond them gets a random key.
DERIVED_KEYS = 8


class Session:
    """Service of a client: address, key and timeout. Most of the operations are described in ``_methods``."""

    def __init__(self, url, key, timeout):
        try:
            parts = urllib.parse.urlsplit(url)
            # The property rejects a port that is not a number.
            _ = parts.port
            if parts.scheme not in ("http", "https") or not parts.hostname or parts.query or parts.fragment:
                raise ValueError
        except ValueError:
            raise ValueError("url must be the address of a service, such as http://127.0.0.1:8080") from None
        # Messages contain the address.
        if "@" in parts.netloc:
            raise ValueError("url must not contain a user name or a password; pass a key as key=")
        # HTTP libraries repeat an invalid header in their messages.
        if key is not None and not (isinstance(key, str) and re.fullmatch(r"[!-~]+", key)):
            raise ValueError("key must be a text of printable ASCII characters without spaces")
        if not (isinstance(timeout, (int, float)) and 0 < timeout < math.inf):
            raise ValueError(f"timeout is {timeout}, expected a positive number of seconds")
        self.url, self.timeout = url.rstrip("/"), float(timeout)
        self.headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        # True once the service has answered: later requests wait for its return.
        self.has_answered = False

    def exchange(self, request):
        """Sends a request, and retries it while it is rejected temporarily. Returns the response of a success."""
        end = time.monotonic() + self.timeout
        for attempt in itertools.count():
            remaining = max(end - time.monotonic(), 0.001)
            try:
                response = yield request._replace(timeout=remaining)
            except (ConnectionError, TimeoutError) as error:
                if not self.has_answered:
                    raise
                failure, pause = error, min(FIRST_PAUSE * 2**attempt, LONGEST_PAUSE)
            else:
                if 200 <= response.status < 300 or response.status == 303:
                    self.has_answered = True
                    return response
                failure, pause = self.failure(response), retry_delay(response)
                if pause is None or not self.has_answered:
                    raise failure
            pause *= random.uniform(1, 1.25)
            if time.monotonic() + pause >= end:
                raise failure
            yield Pause(pause)

    def failure(self, response):
        """Returns the exception of a response that is not a success."""
        problem = parse_problem(response)
        if problem is not None:
            self.has_answered = True
            return to_exception(problem)
        target = f" with a redirection to {response.headers['location']}" if "location" in response.headers else ""
        return ConnectionError(
            f"{self.url} answered {response.status}{target}, without the problem document of a molmesh service"
        )

    def document(self, request):
        """Returns the JSON document that answers a request."""
        return self.document_of((yield from self.exchange(request)))

    def document_of(self, response):
        """Returns the JSON document of a response."""
        document = parse_json(response)
        if not isinstance(document, dict):
            raise ConnectionError(f"{self.url} answered without a JSON document; it is not a molmesh service")
        return document

    def capabilities(self):
        return self.document(Request("GET", "/v1/capabilities"))

    def concurrency(self):
        """Returns the number of jobs of ``map()`` that keeps all workers of the service busy."""
        # As many again send their files or get their results meanwhile.
        return 2 * (yield from self.capabilities())["limits"]["workers"]

    def upload(self, file):
        request = Request("POST", "/v1/structures", body={"content": read(file)})
        return (yield from self.document(request))["digest"]

    def describe(self, path, source, map, parameters):
        """Posts a structure to `path` and returns the document in the response."""
        body = Input(source).body(None if map is None else read(map))
        return (yield from self.document(Request("POST", path, query_pairs(parameters), body=body)))

    def areas(self, source, parameters):
        request = Request("POST", "/v1/areas", query_pairs(parameters), body=Input(source).body())
        return parse_areas((yield from self.exchange(request)).content)

    def requests(self, source, map, prefer, parameters, output=None):
        """Yields the requests for a mesh: the same one with different idempotency keys."""
        input, query, map = Input(source), query_pairs(parameters), None if map is None else read(map)
        digest = input.digest(json.dumps(query).encode(), map or b"")
        request = Request("POST", "/v1/meshes", query, {"Prefer": prefer}, input.body(map), output)
        return self.with_keys(request, digest)

    def with_keys(self, request, digest):
        """Yields the same request with different idempotency keys: those derived from a digest of its content, and a
        random one.
        """
        for number in range(DERIVED_KEYS + 1):
            key = f"{digest}-{number}" if number < DERIVED_KEYS else secrets.token_hex(32)
            yield request._replace(headers={**request.headers, "Idempotency-Key": key})

    def begin(self, requests):
        """Sends requests for a mesh or a batch until one returns the mesh, or a usable job or batch. Returns the last
        response, None if there was no request.
        """
        response = None
        for request in requests:
            try:
                response = yield from self.exchange(request)
            except Error as error:
                # The entry of an archive has changed. A random key, the last one, belongs to no other request.
                if error.type != "other-request":
                    raise
                continue
            if response.status != 202 or not is_spent(self.document_of(response)):
                break
        return response

    def submit(self, source, map, parameters):
        """Returns the id of the job of a mesh."""
        response = yield from self.begin(self.requests(source, map, "respond-async", parameters))
        return self.document_of(response)["jobID"]

    def mesh(self, source, map, output, parameters, is_batch=False):
        """Returns a mesh, or its path after writing it there."""
        prefer = "respond-async" if is_batch else f"wait={int(min(LONGEST_WAIT, self.timeout / 2))}"
        with output:
            requests = self.requests(source, map, prefer, parameters, output)
            content = yield from self.content(requests, None if is_batch else self.timeout, output)
        return output.result(content)

    def content(self, requests, timeout, output):
        """Returns the mesh, sending the next of equal requests if a result is gone."""
        while response := (yield from self.begin(requests)):
            if response.status != 202:
                return response.content
            try:
                return (yield from self.result(self.document_of(response), timeout, output))
            except Error as error:
                # The next request makes it again.
                if error.type != "result-gone":
                    raise
                gone = error
        raise gone

    def job(self, id, wait=0):
        """Returns the status document of a job."""
        return self.document(Request("GET", job_path(id), [("wait", str(wait))] if wait else []))

    def cancel(self, id):
        return self.document(Request("DELETE", job_path(id)))

    def wait(self, id, timeout):
        """Returns the status document of a job that has ended."""
        return self.ended(f"job {id}", lambda seconds: self.job(id, seconds), timeout)

    def ended(self, name, show, timeout):
        """Returns the document of a job or a batch that has ended. `show` is the operation that gets the document; it
        may wait for the end for some seconds.
        """
        end = math.inf if timeout is None else time.monotonic() + timeout
        while True:
            begin = time.monotonic()
            seconds = int(max(min(LONGEST_WAIT, self.timeout / 2, end - begin), 0))
            document = yield from show(seconds)
            if document["status"] in ENDED:
                return document
            now = time.monotonic()
            if now >= end:
                raise TimeoutError(f"the {name} is {document['status']} after {timeout} s")
            # The service answers early if it stops or cannot wait, as for batches, and at once if there is less than a
            # second left to wait.
            if now - begin < max(seconds - POLL_PAUSE, POLL_PAUSE):
                yield Pause(min(POLL_PAUSE, end - now))

    def submit_batch(self, files, parameters):
        """Returns the id of a batch."""
        query = query_pairs(parameters)
        with batch_input(files) as input:
            digest = hashlib.sha256(input.digest + json.dumps(query).encode()).hexdigest()
            request = Request("POST", "/v1/batches", query, input.headers, input.body)
            response = yield from self.begin(self.with_keys(request, digest))
        return self.document_of(response)["batchID"]

    def batch(self, id):
        """Returns the state of a batch with its first files."""
        return self.document(Request("GET", batch_path(id)))

    def cancel_batch(self, id):
        return self.document(Request("DELETE", batch_path(id)))

    def wait_batch(self, id, timeout, progress=None):
        """Returns the state of a batch that has ended. `progress` is called with each state until then."""

        def show(_):
            batch = yield from self.batch(id)
            if progress is not None:
                progress(batch)
            return batch

        return self.ended(f"batch {id}", show, timeout)

    def batch_results(self, id, folder=None):
        """Yields the results of a batch as they arrive: name and content, or with a folder name and path."""
        names, n_before = set(), None
        while True:
            request = Request("GET", f"{batch_path(id)}/results.tar", is_stream=True)
            stream = (yield from self.exchange(request)).content
            archive = ArchiveReader(stream, f"{self.url} cut off the results of the batch {id}")
            try:
                while member := (yield from archive.next()):
                    if member.name in names:
                        # An earlier response had it.
                        yield from archive.copy()
                        continue
                    with Output(None if folder is None else member_path(member, folder)) as output:
                        file = output.restart()
                        yield from archive.copy(file)
                        content = file.getvalue() if folder is None else None
                    names.add(member.name)
                    yield Item((member.name, output.result(content)))
                return
            except tarfile.HeaderError as error:
                raise ConnectionError(f"the service answered without an archive of results: {error}") from None
            except (ConnectionError, TimeoutError):
                # Gives up if the last response brought no new result.
                if n_before == len(names):
                    raise
                n_before = len(names)
            # The service then sends all results at once, so a proxy does not end the response for its pauses.
            yield from self.wait_batch(id, None)

    def list_items(self, path, name, query):
        """Yields the items of a list that the service returns in pages."""
        request = Request("GET", path, [("limit", "1000"), *query])
        while request is not None:
            page = yield from self.document(request)
            yield from map(Item, page[name])
            following = [link["href"] for link in page["links"] if link["rel"] == "next"]
            # The address may have another path behind a proxy.
            query = [urllib.parse.parse_qsl(urllib.parse.urlsplit(href).query) for href in following]
            request = request._replace(query=query[0]) if query else None

    def result(self, job, timeout, output):
        """Returns the result of a job after its end."""
        if job["status"] not in ENDED:
            job = yield from self.wait(job["jobID"], timeout)
        # The response for a failed job has the status of its problem, such as 503, and must not be repeated.
        if job["status"] == "failed":
            raise to_exception(job["problem"])
        redirection = yield from self.exchange(Request("GET", f"{job_path(job['jobID'])}/result"))
        name = urllib.parse.urlsplit(redirection.headers["location"]).path.rpartition("/")[2]
        return (yield from self.exchange(Request("GET", f"/v1/results/{name}", output=output))).content

    def saved_result(self, id, timeout, output):
        """Returns the result of a job, or its path after writing it there."""
        with output:
            content = yield from self.result((yield from self.job(id)), timeout, output)
        return output.result(content)

    def outcome(self, source, output, parameters, error=None):
        """Returns the result of one file of ``map()``. `error` is the reason why it has no output."""
        if error is not None:
            return MapResult(source, error=error)
        try:
            return MapResult(source, (yield from self.mesh(source, None, output, parameters, is_batch=True)))
        except (Error, ValueError, TypeError, OSError) as error:
            return MapResult(source, error=error)

    def outcomes(self, sources, folder, parameters):
        """Yields the operation and the output of each file of ``map()``."""
        extension, taken = parameters["format"].partition("-")[0], {}

        def output_path(source):
            path = pathlib.Path(folder, f"{output_stem(source)}.{extension}")
            if path in taken:
                raise ValueError(f"{path} is the output of {taken[path]} as well")
            taken[path] = source if isinstance(source, (str, os.PathLike)) else "bytes"
            return path

        for source in sources:
            try:
                output = Output(None if folder is None else output_path(source))
            except (ValueError, TypeError, OSError) as error:
                yield self.outcome(source, None, parameters, error), Output()
            else:
                yield self.outcome(source, output, parameters), output
