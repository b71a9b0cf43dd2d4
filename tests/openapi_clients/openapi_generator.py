"""Meshes a file and follows a job with a Python client that openapi-generator made, for tests/http/openapi_clients.rs.

Usage: openapi_generator.py URL FOLDER FILE. FOLDER holds the generated package `client`.
"""

import sys

url, folder, path = sys.argv[1:]
sys.path.insert(0, folder)

from client import ApiClient, ApiException, Configuration, JobsApi, JobStatus, MeshesApi, ResultsApi  # noqa: E402

api = ApiClient(Configuration(host=url))
meshes, jobs, results = MeshesApi(api), JobsApi(api), ResultsApi(api)

glb = meshes.create_mesh(body=path)
assert isinstance(glb, (bytes, bytearray)) and glb[:4] == b"glTF", glb[:100]

job = meshes.create_mesh(body=path, resolution=0.7, prefer="respond-async")
while job.status not in (JobStatus.SUCCESSFUL, JobStatus.FAILED):
    job = jobs.show_job(job.job_id, wait=20)
assert job.status == JobStatus.SUCCESSFUL, job
smaller = results.show_result(job.result)
assert smaller[:4] == b"glTF" and len(smaller) < len(glb), len(smaller)

report = meshes.create_report(body=path)
assert report.closed and report.atoms == 327, report

try:
    meshes.create_mesh(body=b"nothing")
except ApiException as error:
    assert error.status == 422 and error.data.type == "/problems/unreadable-structure", error
else:
    raise AssertionError("not an error")
