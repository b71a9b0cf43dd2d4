"""Batches and lists of jobs of the clients, with a real service and with a server that fails."""

import asyncio
import gc
import io
import json
import os
import tarfile
import threading

import pytest
from conftest import CIF, LONG, PDB, FailingServer, Service, caught, problem, variants

import molmesh


def summary(content):
    return [json.loads(line) for line in content.splitlines()]


def n_sockets():
    """Returns the number of open sockets of this process, without those of forgotten clients."""
    gc.collect()
    return sum(os.path.realpath(file).rpartition("/")[2].startswith("socket:") for file in os.scandir("/proc/self/fd"))


def archive(*files):
    """Returns a tar archive in the form of the service."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=tarfile.GNU_FORMAT) as tar:
        for name, content in files:
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return file.getvalue()


def test_results_are_those_of_single_requests(client, tmp_path):
    long = "long-name" * 15
    files = {"b/1.pdb": PDB, f"{long}/a.cif": CIF.read_bytes(), "broken.pdb": b"no structure"}
    parameters = {"surface": "sas", "resolution": 1, "by": "chain"}
    batch = client.submit_batch(files, outputs=["stl", "areas"], **parameters)
    results = list(batch.results())
    names = ["b/1.stl", "b/1.csv", f"{long}/a.stl", f"{long}/a.csv", "summary.jsonl"]
    assert [name for name, _ in results] == names
    assert results[0][1] == client.mesh(PDB, format="stl", surface="sas", resolution=1)
    assert results[3][1].startswith(b"chain,")
    lines = summary(results[-1][1])
    assert [(line["input"], line["status"]) for line in lines] == [
        ("b/1.pdb", "written"),
        (f"{long}/a.cif", "written"),
        ("broken.pdb", "failed"),
    ]
    # The same bytes in a folder.
    (tmp_path / "b").mkdir()
    (tmp_path / "b/1.stl").write_text("old")
    saved = batch.save(tmp_path)
    assert [(name, path.read_bytes()) for name, path in saved] == results
    assert saved[0][1] == tmp_path / "b/1.stl"
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 5
    states = []
    assert batch.wait(10, progress=states.append)["status"] == "successful"
    assert states[-1]["counts"]["failed"] == 1 and states[-1]["progress"] == 100
    assert [file["file"] for file in batch.files()] == list(files)
    assert [file["status"] for file in client.batch(batch.id).status()["members"]] == ["successful"] * 2 + ["failed"]
    assert caught(batch.cancel).type == "job-ended"
    # The same call is the same batch, another one is not.
    assert client.submit_batch(files, outputs="stl,areas", **parameters).id == batch.id
    assert client.submit_batch(files, outputs="stl", resolution=1, surface="sas").id != batch.id
    with pytest.raises(NotADirectoryError):
        batch.save(tmp_path / "none")


def test_archive_entries_and_wrong_files(client, tmp_path):
    batch = client.submit_batch(["4PTI", "9zzz"], resolution=2)
    *files, (_, lines) = batch.results()
    assert [name for name, _ in files] == ["4pti.glb"] and len(summary(lines)) == 2
    digest = client.upload(PDB)
    for files, message in [
        (["4pti", str(PDB)], "not both: source 1 is a file"),
        ({"a/": PDB}, "'a/' is not the name of a file"),
        ({"a\0b": PDB}, "is not the name of a file"),
        ([digest], "no place for stored structures"),
        ([PDB, PDB.parent / "../samples/4pti.pdb"], "two files have the name 4pti.pdb; name them with a dictionary"),
    ]:
        with pytest.raises(ValueError, match=message):
            client.submit_batch(files)
    with pytest.raises(TypeError, match="files is one str, expected several files"):
        client.submit_batch("4pti")
    with pytest.raises(TypeError, match="found int, expected a path or bytes"):
        client.submit_batch([3])
    with pytest.raises(FileNotFoundError):
        client.submit_batch([tmp_path / "none.pdb"])
    with pytest.raises(ValueError, match="resolutoin"):
        client.submit_batch([PDB], resolutoin=1)
    assert caught(client.submit_batch, []).type == "bad-request"
    assert caught(client.batch("0").status).type == "no-such-job"


def test_a_cancelled_batch_is_made_again(client):
    batch = client.submit_batch([PDB, CIF], **LONG)
    with pytest.raises(TimeoutError, match=f"the batch {batch.id} is"):
        batch.wait(0.3)
    assert client.submit_batch([PDB, CIF], **LONG).id == batch.id
    assert batch.cancel()["status"] == batch.cancel()["status"] == "dismissed"
    assert [name for name, _ in batch.results()] == ["summary.jsonl"]
    again = client.submit_batch([PDB, CIF], **LONG)
    assert again.id != batch.id
    again.cancel()


def test_results_survive_a_kill_of_the_service(tmp_path):
    service = Service(tmp_path)
    files = variants(tmp_path, 8)
    (tmp_path / "out").mkdir()
    restart = threading.Timer(0.5, service.start)
    try:
        with molmesh.Client(service.url) as client:
            batch = client.submit_batch(files, outputs="ply", surface="ses", resolution=0.25)
            results = batch.results()
            found = [next(results)]
            service.kill()
            restart.start()
            found += results
            assert [name for name, _ in found] == [f"{n}.ply" for n in range(8)] + ["summary.jsonl"]
            # Equal atoms give equal meshes.
            assert len({content for _, content in found[:-1]}) == 1
            assert all(line["status"] == "written" for line in summary(found[-1][1]))
    finally:
        if restart.is_alive():
            restart.join()
        service.kill()


def test_results_that_are_cut_off_leave_no_partial_file(tmp_path):
    whole = archive(("a.glb", b"a" * 700), ("b.glb", b"b" * 700), ("summary.jsonl", b"{}"))
    ended = {"status": "successful", "members": [], "counts": {"dismissed": 0}}
    # A header and two blocks for each file.
    for cut in (100, 512 + 300, 1536, 1536 + 512 + 600, 2 * 1536, len(whole.rstrip(b"\0"))):
        n_cut, out = 1, tmp_path / str(cut)

        def answer(method, path, number):
            nonlocal n_cut
            if not path.endswith(".tar"):
                return 200, {}, json.dumps(ended).encode()
            n_cut -= 1
            return 200, {}, whole[:cut] if n_cut >= 0 else whole

        out.mkdir()
        with FailingServer(answer) as server:
            batch = molmesh.Client(server.url).batch("id")
            # Each file once, in spite of the second request.
            names = [name for name, _ in batch.results()]
            assert names == ["a.glb", "b.glb", "summary.jsonl"]
            n_cut = 100
            with pytest.raises(ConnectionError, match="cut off the results of the batch id"):
                batch.save(out)
            complete = cut // 1536
            assert sorted(path.name for path in out.iterdir()) == ["a.glb", "b.glb"][:complete]
            assert n_cut == 98


def test_names_do_not_lead_out_of_the_folder(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    for name in ("../x.glb", "a/../../x.glb", "link/x.glb"):
        with FailingServer(lambda *_: (200, {}, archive(("good.glb", b"x"), (name, b"x")))) as server:
            with pytest.raises(tarfile.FilterError):
                molmesh.Client(server.url).batch("id").save(folder)
    assert {path.name for path in tmp_path.rglob("*")} == {"folder", "link", "good.glb"}
    link = tarfile.TarInfo("a.glb")
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
    for content in (link.tobuf(), b"<html>" * 200):
        with FailingServer(lambda *_: (200, {}, content)) as server:
            with pytest.raises(ConnectionError, match="without an archive of results"):
                molmesh.Client(server.url).batch("id").save(folder)
    assert not (folder / "a.glb").exists()


def test_a_rejected_batch_is_sent_again_as_a_whole():
    busy = problem("queue-full", 503, {"Retry-After": "1"})
    accepted = (202, {}, json.dumps({"batchID": "id", "status": "accepted", "members": [], "counts": {}}).encode())
    with FailingServer(lambda method, path, number: accepted if number % 2 else busy) as server:
        assert molmesh.Client(server.url).submit_batch([PDB, CIF]).id == "id"

        async def work():
            async with molmesh.AsyncClient(server.url) as client:
                return (await client.submit_batch([PDB, CIF])).id

        assert asyncio.run(work()) == "id"
        assert len({headers["Idempotency-Key"] for headers in server.headers}) == 1
        sizes = [int(headers["Content-Length"]) for headers in server.headers]
        assert len(sizes) == 4 and 0 < min(sizes) == max(sizes) < PDB.stat().st_size + CIF.stat().st_size


def test_jobs_are_listed_over_all_pages(client):
    jobs = {client.submit(PDB, resolution=1 + n / 10).id for n in range(3)}
    for id in jobs:
        client.job(id).wait(60)
    listed = [job["jobID"] for job in client.jobs("successful")]
    assert jobs <= set(listed) and len(set(listed)) == len(listed)
    cancelled = client.submit(PDB, **LONG)
    cancelled.cancel()
    dismissed = {job["jobID"]: job["status"] for job in client.jobs("dismissed")}
    assert cancelled.id in dismissed and set(dismissed.values()) == {"dismissed"}
    with pytest.raises(ValueError, match="state"):
        next(client.jobs("none"))
    pages = {"limit=1000&state=running": [1, 2], "limit=1000&after=b": [], "limit=1000&after=c": [3]}
    following = dict(zip(pages, ["b", "c"]))

    def answer(method, path, number):
        query = path.partition("?")[2]
        after = following.get(query)
        # Behind a proxy, the service does not know its own address.
        links = [{"rel": "next", "href": f"http://other/v1/jobs?limit=1000&after={after}"}] if after else []
        return 200, {}, json.dumps({"jobs": pages[query], "links": links}).encode()

    with FailingServer(answer) as server:
        assert list(molmesh.Client(server.url).jobs("running")) == [1, 2, 3]
        assert server.n_requests == 3


def test_async_batches_do_the_same(service, tmp_path):
    async def work():
        async with molmesh.AsyncClient(service.url) as client:
            batch = await client.submit_batch([PDB, CIF], outputs="ply", resolution=2)
            assert isinstance(batch, molmesh.AsyncBatch)
            names = [name async for name, _ in batch.results()]
            assert names == ["4pti.ply", "1crn.ply", "summary.jsonl"]
            assert [name for name, _ in await batch.save(tmp_path)] == names
            assert (await batch.wait())["status"] == (await batch.status())["status"] == "successful"
            assert [file["file"] async for file in batch.files()] == ["4pti.pdb", "1crn.cif"]
            assert {job["status"] async for job in client.jobs("successful")} == {"successful"}
            long = await client.submit_batch([PDB], **LONG)
            # The results of a task that is cancelled hold no connection.
            n_before = n_sockets()
            reading = asyncio.create_task(anext(client.batch(long.id).results()))
            await asyncio.sleep(0.2)
            assert n_sockets() == n_before
            reading.cancel()
            with pytest.raises(asyncio.CancelledError):
                await reading
            assert n_sockets() == n_before - 1
            assert (await long.cancel())["status"] == "dismissed"

    asyncio.run(work())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1crn.ply", "4pti.ply", "summary.jsonl"]


def test_results_that_are_left_early_hold_no_connection(client, tmp_path):
    batch = client.submit_batch([PDB, CIF], outputs="ply", resolution=2)
    n_before = n_sockets()
    results = batch.results()
    assert next(results)[0] == "4pti.ply"
    # That of the previous request.
    assert n_sockets() == n_before
    results.close()
    assert n_sockets() == n_before - 1
    assert client.capabilities()["name"] == "molmesh"
    (tmp_path / "4pti.ply").mkdir()
    # The traceback of the error refers to the response.
    with pytest.raises(OSError, match="is not a regular file") as error:
        batch.save(tmp_path)
    assert n_sockets() == n_before - 1 and error.tb is not None
