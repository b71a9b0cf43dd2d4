"""Meshes a file and follows a job with a client that openapi-python-client generated. Used by
tests/http/openapi_clients.rs.

Usage: openapi_python_client.py URL FOLDER FILE. FOLDER holds the generated package `client`.
"""

import io
import pathlib
import sys

url, folder, path = sys.argv[1:]
sys.path.insert(0, folder)

from client import Client  # noqa: E402
from client.api.jobs import show_job  # noqa: E402
from client.api.meshes import create_mesh, create_report  # noqa: E402
from client.api.results import show_result  # noqa: E402
from client.models import JobDocument, JobStatus, Problem, ReportDocument  # noqa: E402
from client.types import File  # noqa: E402

client = Client(base_url=url)


def file():
    return File(payload=io.BytesIO(pathlib.Path(path).read_bytes()))


mesh = create_mesh.sync(client=client, body=file())
assert isinstance(mesh, File), mesh
glb = mesh.payload.read()
assert glb[:4] == b"glTF", glb[:100]

job = create_mesh.sync(client=client, body=file(), resolution=0.7, prefer="respond-async")
assert isinstance(job, JobDocument), job
while job.status not in (JobStatus.SUCCESSFUL, JobStatus.FAILED):
    job = show_job.sync(job.job_id, client=client, wait=20)
assert job.status == JobStatus.SUCCESSFUL, job
result = show_result.sync(job.result, client=client)
assert isinstance(result, File), result
smaller = result.payload.read()
assert smaller[:4] == b"glTF" and len(smaller) < len(glb), len(smaller)

report = create_report.sync(client=client, body=file())
assert isinstance(report, ReportDocument) and report.closed and report.atoms == 327, report

problem = create_mesh.sync(client=client, body=File(payload=io.BytesIO(b"nothing")))
assert isinstance(problem, Problem) and problem.status == 422, problem
