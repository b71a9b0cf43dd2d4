"""Tests of the comparison: `MOLMESH=BINARY python test_peers.py`.

Requires the packages that tests/tools/setup.sh installs (freesasa, gemmi, numpy, trimesh), but no other peers.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
import unittest
from pathlib import Path

import numpy as np

import atom_arrays
import check
import gpu_field
import peers
import tables
from catalog import Job, Peer
from install import ROOT

HERE = Path(__file__).resolve().parent
MOLMESH = os.environ["MOLMESH"]
SAMPLE = ROOT / "samples/4pti.pdb"
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float64)
SIDES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


class Checker(unittest.TestCase):
    def test_a_tetrahedron_is_closed(self):
        report = check.report(CORNERS, SIDES)
        self.assertTrue(report["closed"] and not report["merged"])
        self.assertAlmostEqual(report["volume"], 1 / 6)
        self.assertAlmostEqual(report["area"], 1.5 + 3**0.5 / 2)
        self.assertLess(check.report(CORNERS, SIDES[:, ::-1])["volume"], 0)

    def test_a_missing_triangle_is_detected(self):
        report = check.report(CORNERS, SIDES[1:])
        self.assertEqual((report["closed"], report["open_edges"], report["crowded_edges"]), (False, 3, 0))

    def test_a_doubled_triangle_is_found(self):
        report = check.report(CORNERS, np.concatenate([SIDES, SIDES[:1]]))
        self.assertEqual((report["closed"], report["open_edges"], report["crowded_edges"]), (False, 0, 3))

    def test_only_unshared_vertices_are_merged(self):
        soup = CORNERS[SIDES].reshape(-1, 3), np.arange(12).reshape(4, 3)
        report = check.report(*soup)
        self.assertTrue(report["closed"] and report["merged"])
        self.assertEqual(report["vertices"], 4)
        self.assertEqual(check.report(soup[0][:9], soup[1][:3])["open_edges"], 3)
        # The last triangle has separate vertices at the same positions, so the mesh is open by its indices.
        report = check.report(np.concatenate([CORNERS, CORNERS[1:]]), np.concatenate([SIDES[:3], [[4, 5, 6]]]))
        self.assertEqual((report["closed"], report["merged"], report["open_edges"]), (False, False, 6))

    def test_text_files_are_read(self):
        with tempfile.TemporaryDirectory() as folder:
            obj, ply = str(Path(folder) / "a.obj"), str(Path(folder) / "a.ply")
            lines = [f"v {x} {y} {z}\nvn 0 0 1" for x, y, z in CORNERS]
            Path(obj).write_text("\n".join(lines + [" ".join(["f", *(f"{i + 1}//{i + 1}" for i in f)]) for f in SIDES]))
            head = ["ply", "format ascii 1.0", "element vertex 4", "property float x", "property float y",
                    "property float z", "property uchar red", "element face 4", "property list uchar int vertex_indices",
                    "property uchar red", "end_header"]  # fmt: skip
            body = [f"{x} {y} {z} 7" for x, y, z in CORNERS] + [f"3 {a} {b} {c} 9" for a, b, c in SIDES]
            Path(ply).write_text("\n".join(head + body) + "\n")
            for path in (obj, ply):
                vertices, faces = check.load(path)
                self.assertTrue(np.array_equal(vertices, CORNERS) and np.array_equal(faces, SIDES), path)


class Tables(unittest.TestCase):
    def programs(self):
        mesh = {"triangles": 1000, "closed": True, "merged": False, "open_edges": 0, "crowded_edges": 0,
                "area": 10.0, "volume": 2.0}  # fmt: skip

        def runs(*walls):
            return [{"round": i, "wall": wall, "kb": 2048 * wall} for i, wall in enumerate(walls)]

        return tables.summary({
            "molmesh": {"surface": "same", "runs": runs(1, 2, 4), "mesh": mesh},
            # Ratios 10, 3, 1 have the median 3, like the ratio of the medians 6 and 2. They differ for `far`.
            "near": {"surface": "same", "runs": runs(10, 6, 4), "mesh": {**mesh, "triangles": 1049}},
            "far": {"surface": "ses", "runs": runs(3, 4, 20), "mesh": {**mesh, "triangles": 500, "closed": False,
                                                                       "open_edges": 3, "merged": True}},
            "slow": {"surface": "gaussian", "limit": 60},
            "broken": {"surface": "other", "failed": "status 1, a | b"},
            "absent": {"surface": "ses", "missing": "no such package"},
        })  # fmt: skip

    def test_medians_and_ratios(self):
        programs = self.programs()
        self.assertEqual((programs["molmesh"]["seconds"], programs["molmesh"]["times_ours"]), (2, 1))
        self.assertEqual((programs["near"]["seconds"], programs["near"]["times_ours"]), (6, 3))
        self.assertNotIn("times_ours_per_triangle", programs["near"])
        self.assertEqual((programs["far"]["seconds"], programs["far"]["times_ours"]), (4, 3))
        self.assertEqual(programs["far"]["times_ours_per_triangle"], 6)
        self.assertEqual(programs["slow"]["times_ours_at_least"], 30)

    def test_all_programs_have_rows(self):
        programs = self.programs()
        structure = {"name": "4pti", "atoms": 454, "programs": programs}
        title, rows = tables.section(structure)
        self.assertEqual(title, "4PTI: 454 atoms")
        self.assertEqual([cells[0] for cells in rows], list(programs))
        self.assertTrue(all(len(cells) == len(tables.HEAD) for cells in rows))
        text = tables.markdown(rows)
        for words in ("more than 60", "> 30", "failed: status 1, a / b", "not available: no such package",
                      "no: 3 open edges, 0 with more than two triangles (merged)"):  # fmt: skip
            self.assertIn(words, text)
            if "open edges" not in words:
                self.assertIn(words, tables.terminal(rows))
        overview = tables.overview({"structures": [structure]})
        for line in ("| near | 3 |", "| slow | > 30 |", "| absent | – |"):
            self.assertIn(line, overview)

    def test_a_package_has_one_row_for_one_and_for_all_cores(self):
        def group(cores, runs):
            entries = {"molmesh": {"runs": runs}, "rust": {"runs": [{**run, "wall": 3 * run["wall"]} for run in runs]},
                       "freesasa": {"missing": "freesasa==2.2.1: pip failed"}}  # fmt: skip
            programs = {name: {"surface": "SAS area of atoms", "mesh": {"area": 3978.0}, **entry}
                        for name, entry in entries.items()}  # fmt: skip
            return {"name": "4pti", "atoms": 454, "cores": cores, "load": 0.5, "programs": tables.summary(programs)}

        machine = {"cpu": "x", "cores": 4, "memory_gb": 1, "system": "Linux", "load": 0.5}
        groups = [group(1, [{"round": 0, "wall": 2, "kb": 1024}]), group(4, [{"round": 0, "wall": 0.5, "kb": 2048}])]
        page = tables.page({"machine": machine, "date": "2026-11-22", "spacing": 0.5, "rounds": 1, "limit": 9.0,
                            "versions": {"rust": "rust 0.7.3, numpy 2.4.6"}, "structures": groups})  # fmt: skip
        for cells in ("| task | package | 1 core: s | × time | 4 cores: s | × time | MB | triangles | closed | area",
                      "| molmesh | 2 | 1 | 0.5 | 1 | 2 | – | – | 3,978 |",
                      "| rust 0.7.3 | 6 | 3 | 1.5 | 3 | 2 | – | – | 3,978 |",
                      "| freesasa | not available: freesasa==2.2.1: pip failed | – | – | – | – |"):  # fmt: skip
            self.assertIn(cells, page)

    def test_page_content_between_markers_is_replaced(self):
        begin, end = "<!-- x: begin -->", "<!-- x: end -->"
        self.assertEqual(tables.between(f"a\n{begin}\nold\n{end}\nb", "new", "x"), f"a\n{begin}\n\nnew\n\n{end}\nb")
        for broken in (f"{begin} only", f"{end} {begin}", f"{begin} {begin} {end}"):
            self.assertRaises(ValueError, tables.between, broken, "new", "x")


class Runs(unittest.TestCase):
    def launch(self, *command, limit=60):
        with tempfile.TemporaryDirectory() as folder:
            job = Job("x", SAMPLE, Path(folder), 1.0, Path(folder) / "mesh")
            peer = Peer("x", "same", ".out", lambda job: [*command], lambda: "1")
            return peers.launch(peer, job, limit)

    def test_failures_are_reported(self):
        self.assertEqual(self.launch("sh", "-c", "echo no atoms >&2; exit 4"), {"failed": "status 4, no atoms"})
        self.assertEqual(self.launch("true"), {"failed": "status 0"})
        self.assertIn("failed", self.launch("/no/such/program"))
        self.assertEqual(self.launch("sh", "-c", "sleep 600 & wait", limit=0.2), {"limit": 0.2})
        self.assertEqual(self.launch("sh", "-c", "kill -9 $PPID"), {"failed": "launch.py ended with -9"})

    def test_memory_is_that_of_the_command(self):
        write = "open('mesh.out', 'w').write('x')"
        small = self.launch("sh", "-c", "echo x > mesh.out")
        large = self.launch("sh", "-c", f"{sys.executable} -S -c \"b = bytearray(200 << 20); {write}\"; true")
        self.assertLess(small["kb"], 100 << 10)
        self.assertGreater(large["kb"], 200 << 10)

    def test_a_package_reports_the_time_of_its_calls(self):
        with tempfile.TemporaryDirectory() as folder:
            target, atoms = str(Path(folder) / "mesh"), str(Path(folder) / "4pti.npz")
            np.savez(atoms, **atom_arrays.arrays(SAMPLE))
            command = [sys.executable, str(HERE / "package_peer.py"), "SAS area of atoms", "freesasa", "1", "0.5", atoms,
                       str(SAMPLE), target]  # fmt: skip
            job = Job("4pti", SAMPLE, Path(folder), 0.5, Path(target))
            peer = Peer("freesasa", "SAS area of atoms", ".json", lambda job: command, lambda: "1")
            begin = time.perf_counter()
            outcome = peers.launch(peer, job, 60)
            # The start of Python and the import of numpy are in the time of the process alone.
            self.assertLess(outcome["wall"] + 0.02, time.perf_counter() - begin)
            # The exact area is 3,977.7 Å².
            self.assertLess(abs(outcome["area"] / 3977.7 - 1), 0.005)
            self.assertGreater(outcome["kb"], 10 << 10)

    def test_molmesh_alone(self):
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder) / "peers.json"
            command = [sys.executable, str(HERE / "peers.py"), "--molmesh", MOLMESH, "--only", "molmesh", "--files",
                       str(SAMPLE), "--rounds", "1", "--spacing", "1", "--json", str(target)]  # fmt: skip
            done = subprocess.run(command, capture_output=True, text=True)
            self.assertEqual(done.returncode, 0, done.stderr)
            (structure,) = json.loads(target.read_text())["structures"]
        self.assertEqual((structure["name"], structure["atoms"]), ("4pti", 454))
        (entry,) = structure["programs"].values()
        self.assertEqual(len(entry["runs"]), 1)
        self.assertTrue(entry["mesh"]["closed"] and not entry["mesh"]["merged"])
        self.assertIn("4PTI: 454 atoms", done.stdout)

    def test_the_array_program_computes_our_mesh(self):
        with tempfile.TemporaryDirectory() as folder:
            atoms = Path(folder) / "4pti.npz"
            np.savez(atoms, **atom_arrays.arrays(SAMPLE))
            command = [MOLMESH, "mesh", str(SAMPLE), "--resolution", "2", "--backend", "cpu", "--report", "json"]
            done = subprocess.run([*command, "-o", str(Path(folder) / "x.ply")], capture_output=True, text=True)
            ours, case = json.loads(done.stdout), gpu_field.Case(atoms, 2.0)
            measured, _ = gpu_field.measure(gpu_field.NumpyBaseline(), case, 0, 1)
        self.assertEqual((measured["triangles"], measured["bad_edges"]), (ours["triangles"], 0))
        # The array program interpolates linearly; molmesh then moves the vertices to the isosurface.
        self.assertLess(abs(measured["volume"] / ours["volume"] - 1), 0.1)
        self.assertLess(measured["largest_field_error"], 1e-5)
        self.assertEqual(gpu_field.open_edges(SIDES[1:], 4), 3)


if __name__ == "__main__":
    unittest.main()
