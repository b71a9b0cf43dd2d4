"""Clients, with a real service and with a server that fails."""

import asyncio
import json
import pickle
import subprocess
import sys
import threading
import time
import traceback
import types

import numpy as np
import pytest
from conftest import CIF, COMMAND, LONG, PDB, FailingServer, Service, caught, problem, variants

import molmesh

KEY = "mm_test_" + "0123456789abcdef" * 4


def test_meshes_are_those_of_the_package(client, tmp_path):
    local = tmp_path / "local.glb"
    molmesh.surface(PDB, surface="ses", chains=["A"], atom_ids=True).save(local)
    given = {"surface": "ses", "chains": ["A"], "atom_ids": np.True_, "probe": None}
    digest = client.upload(PDB)
    for source in (PDB, str(PDB), PDB.read_bytes(), digest, "4pti"):
        assert client.mesh(source, **given) == local.read_bytes()
    saved = client.mesh(PDB, save=tmp_path / "a.ply", resolution=1)
    assert saved == tmp_path / "a.ply" and saved.read_bytes().startswith(b"ply")
    assert client.picture(CIF, width=64, height=64).startswith(b"\x89PNG")
    with pytest.raises(TypeError, match="multiple values for keyword argument 'format'"):
        client.picture(CIF, format="glb")
    dx = b"object 1 class gridpositions counts 2 2 2\norigin -99 -99 -99\ndelta 199 0 0\ndelta 0 199 0\ndelta 0 0 199\n"
    dx += b"object 3 class array type double rank 0 items 8 data follows\n0 1 2\n3 4 5\n6 7\n"
    assert client.report(PDB, map=dx, color="map", resolution=2)["color"]["scheme"] == "map"
    with pytest.raises(ValueError, match="a map needs a structure file"):
        client.report(digest, map=dx, color="map")
    report = client.report(digest, surface="vdw", exact=True)
    assert report["closed"] and report["exact"]["area"] > 3000
    assert client.estimate(PDB, resolution=0.01)["accepted"] in (True, False)
    assert client.capabilities()["limits"]["workers"] == 2
    assert [file.name for file in tmp_path.iterdir() if file.suffix == ".part"] == []


def test_areas_are_those_of_the_package(client):
    # Tables mark a name that a spreadsheet would execute.
    signs = PDB.read_text().replace(" A  ", " =  ").encode()
    assert set(molmesh.areas(signs, surface="sas")["chain"]) == {"="}
    for source, by, surface in [(PDB, "atom", "sas"), (PDB, "residue", "ses"), (signs, "chain", "vdw")]:
        expected, found = molmesh.areas(source, by=by, surface=surface), client.areas(source, by=by, surface=surface)
        assert list(found) == list(expected)
        for name, column in expected.items():
            assert found[name].dtype.kind == column.dtype.kind, name
            if column.dtype.kind == "f":
                assert np.allclose(found[name], column, atol=1e-3), name
            else:
                assert np.array_equal(found[name], column), name


def test_errors_are_those_of_the_package(client, tmp_path):
    broken = PDB.read_text().replace(" 26.465 ", " 26.4x5 ", 1).encode()
    far = b"ATOM      1  N   GLY A   1       0.000   0.000   0.000  1.00  0.00           N\n"
    for source, given in [
        (broken, {}),
        (b"no structure", {}),
        (PDB, {"chains": "Z"}),
        (PDB, {"isovalue": 1000}),
        (far, {"surface": "vdw", "radius_offset": 10, "resolution": 0.01}),
    ]:
        remote, local = caught(client.mesh, source, **given), caught(molmesh.surface, source, **given)
        for field in ("type", "value", "line", "column", "suggested_resolution"):
            assert getattr(remote, field) == getattr(local, field), (given, field)
        # The service has other limits.
        assert (remote.limit is None) == (local.limit is None)
        assert type(remote) is molmesh.Error
        copy = pickle.loads(pickle.dumps(remote))
        assert (copy.type, str(copy)) == (remote.type, str(remote))
    with pytest.raises(ValueError, match="unknown parameter `resolutoin`; did you mean `resolution`"):
        client.mesh(PDB, resolutoin=1)
    with pytest.raises(FileNotFoundError):
        client.mesh(tmp_path / "none.pdb")
    with pytest.raises(FileNotFoundError) as error:
        client.mesh(PDB, save=tmp_path / "none/a.glb")
    assert error.value.filename == str(tmp_path / "none/a.glb")
    with pytest.raises(TypeError, match="found int, expected a path or bytes"):
        client.mesh(3)
    assert caught(client.mesh, "0" * 64).type == "no-such-structure"
    assert caught(client.areas, "9zzz", surface="sas").type == "not-in-archive"


def test_jobs_run_wait_and_are_cancelled(client):
    job = client.submit(PDB, format="stl", resolution=1)
    assert job.wait(60)["status"] == "successful" and len(job.result()) > 84
    assert client.job(job.id).status()["structure"] == client.upload(PDB)
    assert caught(job.cancel).type == "job-ended"
    long = client.submit(PDB, **LONG)
    begin = time.monotonic()
    with pytest.raises(TimeoutError, match=f"the job {long.id} is"):
        long.wait(0.3)
    assert time.monotonic() - begin < 3
    assert client.submit(PDB, **LONG).id == long.id
    assert long.cancel()["status"] == long.cancel()["status"] == "dismissed"
    assert caught(long.result).type == "job-dismissed"
    # The same request again is new work.
    again = client.submit(PDB, **LONG)
    assert again.id != long.id and again.status()["status"] in ("accepted", "running")
    again.cancel()
    assert caught(client.job("0").status).type == "no-such-job"


def test_a_mesh_that_takes_long_becomes_a_job(service):
    # The service waits for half of the time.
    with molmesh.Client(service.url, timeout=2) as client:
        before = set(service.jobs())
        with pytest.raises(TimeoutError, match="the job"):
            client.mesh(PDB, **LONG)
        (id,) = set(service.jobs()) - before
        client.job(id).cancel()


def test_other_processes_get_the_same_job(client, service):
    job = client.submit(PDB, resolution=0.9, atom_ids=True)
    call = f"molmesh.Client({service.url!r}).submit({str(PDB)!r}, atom_ids=True, resolution=0.9)"
    script = [sys.executable, "-c", f"import molmesh; print({call}.id)"]
    other = subprocess.run(script, check=True, capture_output=True, text=True, timeout=60)
    assert other.stdout.strip() == job.id


def test_map_survives_a_kill_of_the_service(tmp_path):
    service = Service(tmp_path)
    files = variants(tmp_path, 10)
    files[4].write_text("no structure")
    (tmp_path / "out").mkdir()
    restart = threading.Timer(0.5, service.start)
    try:
        with molmesh.Client(service.url) as client:
            results = client.map(files, format="ply", save=tmp_path / "out", surface="ses", resolution=0.25)
            found = [next(results), next(results)]
            service.kill()
            restart.start()
            found += results
            assert sorted(result.source for result in found) == files
            assert [result.error.type for result in found if result.error] == ["unreadable-structure"]
            meshes = {result.content.read_bytes() for result in found if not result.error}
            # Equal atoms give equal meshes.
            assert len(meshes) == 1 and len(service.jobs()) == 9
            # A program that ended early gets its jobs again.
            begun = client.map(files[:2], resolution=0.35)
            next(begun)
            begun.close()
            assert all(result.error is None for result in client.map(files[:2], resolution=0.35))
            assert len(service.jobs()) == 11
    finally:
        if restart.is_alive():
            restart.join()
        service.kill()


def test_map_names_outputs_and_shows_progress(client, tmp_path, monkeypatch):
    copy = tmp_path / "4pti.pdb"
    copy.write_bytes(PDB.read_bytes())
    results = list(client.map([copy, PDB, "4pti", CIF.read_bytes(), 3], save=tmp_path, format="ply-text", resolution=2))
    assert len(results) == 5 and sum(result.error is not None for result in results) == 3
    assert "is the output of" in str(next(result.error for result in results if result.source == PDB))
    assert len(list(tmp_path.glob("*.ply"))) == 2
    with pytest.raises(ValueError, match="concurrency is 0"):
        client.map([], concurrency=0)
    for file in (PDB, str(PDB), PDB.read_bytes()):
        with pytest.raises(TypeError, match=f"files is one {type(file).__name__}, expected several files"):
            client.map(file)
    for folder in (tmp_path / "none", copy):
        with pytest.raises(NotADirectoryError) as error:
            client.map([PDB], save=folder)
        assert error.value.filename == str(folder)
    seen = []

    def bar(iterable, total, unit):
        for item in iterable:
            seen.append(total)
            yield item

    monkeypatch.setitem(sys.modules, "tqdm.auto", types.SimpleNamespace(tqdm=bar))
    assert len(list(client.map([PDB, CIF], resolution=2, progress=True))) == 2 and seen == [2, 2]
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with pytest.raises(ImportError, match="pip install tqdm"):
        client.map([PDB], progress=True)


def test_async_clients_do_the_same(service, tmp_path):
    async def work():
        async with molmesh.AsyncClient(service.url) as client:
            meshes = await asyncio.gather(*(client.mesh(PDB, resolution=1 + n / 10) for n in range(4)))
            assert len(set(meshes)) == 4
            job = await client.submit(PDB, resolution=1)
            assert isinstance(job, molmesh.AsyncJob) and (await job.wait())["status"] == "successful"
            assert await job.result(save=tmp_path / "a.glb") == tmp_path / "a.glb"
            assert (tmp_path / "a.glb").read_bytes() == meshes[0]
            long = await client.submit(PDB, **LONG)
            assert (await long.cancel())["status"] == "dismissed"
            assert (await client.areas(PDB, surface="sas"))["area"].sum() > 3000
            with pytest.raises(ValueError):
                await client.mesh(PDB, resolution=0)
            results = [result async for result in client.map([PDB, "no.pdb", CIF], resolution=2)]
            assert sorted(result.error is None for result in results) == [False, True, True]

    asyncio.run(work())


@pytest.mark.parametrize("kind", ["Client", "AsyncClient"])
def test_map_has_twice_as_many_requests_as_there_are_workers(kind):
    barrier, active, most, lock = threading.Barrier(4, timeout=20), 0, 0, threading.Lock()

    def answer(method, path, number):
        nonlocal active, most
        if method == "GET":
            return 200, {}, b'{"limits": {"workers": 2}}'
        with lock:
            active += 1
            most = max(most, active)
        barrier.wait()
        with lock:
            active -= 1
        return problem("no-atoms", 422)

    async def run(client):
        return [result async for result in client.map([b"x"] * 8)]

    with FailingServer(answer) as server:
        client = getattr(molmesh, kind)(server.url)
        results = list(client.map([b"x"] * 8)) if kind == "Client" else asyncio.run(run(client))
    assert [result.error.type for result in results] == ["no-atoms"] * 8 and most == 4


def test_rejected_requests_are_repeated_in_time():
    busy = {"Retry-After": "1"}
    answers = [problem("queue-full", 503, busy), problem("quota-exceeded", 429, busy), (200, {}, b'{"a": 1}')]
    with FailingServer(lambda method, path, number: answers[number]) as server:
        begin = time.monotonic()
        assert molmesh.Client(server.url).capabilities() == {"a": 1}
        assert 2 <= time.monotonic() - begin < 5 and server.n_requests == 3
    with FailingServer(lambda *_: problem("quota-exceeded", 429, {"Retry-After": "60"}, limit=7)) as server:
        begin = time.monotonic()
        error = caught(molmesh.Client(server.url, timeout=10).capabilities)
        # The quota is not available in time, so the client does not wait.
        assert (error.type, error.limit) == ("quota-exceeded", 7)
        assert time.monotonic() - begin < 5 and server.n_requests == 1
    with FailingServer(lambda *_: problem("internal", 500)) as server:
        assert str(caught(molmesh.Client(server.url).capabilities)) == "d (request i)"
        assert server.n_requests == 1


def test_a_download_that_breaks_is_repeated(tmp_path):
    parts = [(200, {"Content-Length": "9"}, b"glTF1"), (200, {}, b"glTF12345")]

    def answer(method, path, number):
        return (200, {}, b"{}") if number == 0 else parts[number - 1]

    with FailingServer(answer) as server:
        client = molmesh.Client(server.url)
        client.capabilities()
        assert client.mesh(b"x", save=tmp_path / "a.glb").read_bytes() == b"glTF12345"
        assert server.n_requests == 3 and len(list(tmp_path.iterdir())) == 1
        keys = {headers["Idempotency-Key"] for headers in server.headers[1:]}
        assert len(keys) == 1


def test_map_that_ends_early_leaves_no_partial_file(tmp_path):
    ids, ended = iter(["whole", "partial"]), threading.Event()

    def answer(method, path, number):
        if path == "/v1/capabilities":
            return 200, {}, b'{"limits": {"workers": 1}}'
        if method == "POST":
            return 202, {}, json.dumps({"status": "successful", "jobID": next(ids), "problem": None}).encode()
        if path.endswith("/result"):
            return 303, {"Location": f"/v1/results/{path.split('/')[3]}.glb"}, b""
        return 200, {"Content-Length": "5" if "whole" in path else "9"}, b"glTF1"

    with FailingServer(answer, lambda path: ended.wait(20) if "partial.glb" in path else None) as server:
        results = molmesh.Client(server.url).map([b"a", b"b"], save=tmp_path)
        assert next(results).content.read_bytes() == b"glTF1"
        end = time.monotonic() + 20
        while not list(tmp_path.glob("*.part")) and time.monotonic() < end:
            time.sleep(0.01)
        assert len(list(tmp_path.iterdir())) == 2
        # The thread still waits for the rest of the response.
        results.close()
        assert [file.suffix for file in tmp_path.iterdir()] == [".glb"]
        ended.set()


def test_services_that_do_not_answer_are_transport_errors():
    with FailingServer(lambda *_: time.sleep(2) or (200, {}, b"{}")) as server:
        begin = time.monotonic()
        with pytest.raises(TimeoutError, match="no response from http://127.0.0.1"):
            molmesh.Client(server.url, timeout=0.4).capabilities()
        assert time.monotonic() - begin < 2
    # The server is gone.
    begin = time.monotonic()
    with pytest.raises(ConnectionError, match="no response from http://127.0.0.1"):
        molmesh.Client(server.url).capabilities()
    assert time.monotonic() - begin < 5
    for status, headers, content, message in [
        (404, {}, b"<html>", "answered 404, without the problem document"),
        (301, {"Location": "https://other"}, b"", "with a redirection to https://other"),
        (200, {}, b"<html>", "without a JSON document"),
    ]:
        with FailingServer(lambda *_, answer=(status, headers, content): answer) as server:
            with pytest.raises(ConnectionError, match=message):
                molmesh.Client(server.url).capabilities()


def test_keys_are_sent_and_never_shown(tmp_path):
    made = subprocess.run([COMMAND, "key", "new", "--id", "tests"], check=True, capture_output=True, text=True)
    (tmp_path / "keys.toml").write_text(made.stdout)
    (key,) = [word for word in made.stderr.split() if word.startswith("mm_")]
    service = Service(tmp_path, "--set", f"access.keys_file={tmp_path / 'keys.toml'}")
    try:
        assert molmesh.Client(service.url, key).capabilities()["name"] == "molmesh"
        assert caught(molmesh.Client(service.url).capabilities).type == "key-required"
        client = molmesh.Client(service.url, key=KEY)
        with pytest.raises(molmesh.Error) as error:
            list(client.map([PDB]))
        assert error.value.type == "key-invalid"
        shown = "".join(traceback.format_exception(error.value)) + repr(client) + repr(vars(error.value))
        assert "mm_test" not in shown
    finally:
        service.kill()


def test_bad_addresses_keys_and_times_are_value_errors():
    for url in ("127.0.0.1:8080", "ftp://host", "http://", "http://host:port", "http://[::1", "http://host?a=b"):
        with pytest.raises(ValueError, match="url must be the address of a service"):
            molmesh.Client(url)
    with pytest.raises(ValueError) as error:
        molmesh.Client(f"http://user:{KEY}@host")
    assert KEY not in str(error.value)
    for key in (KEY + "\n", "é" + KEY, f"{KEY} ", "", KEY.encode()):
        with pytest.raises(ValueError) as error:
            molmesh.Client("http://host", key)
        assert "mm_test" not in str(error.value)
    for timeout in (0, -1, float("nan"), float("inf"), "1"):
        with pytest.raises(ValueError):
            molmesh.Client("http://host", timeout=timeout)


def test_the_package_is_imported_without_the_http_library():
    script = "import sys, molmesh; assert 'httpx' not in sys.modules; molmesh.Client; assert 'httpx' in sys.modules"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)
    with pytest.raises(AttributeError, match="module 'molmesh' has no attribute 'none'"):
        molmesh.none
    assert {"Client", "AsyncClient", "surface"} <= set(dir(molmesh))
