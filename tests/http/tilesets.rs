//! Tilesets and tiles of the service.
#![allow(clippy::pedantic, reason = "tests fail by panicking")]

use crate::http_support;
use crate::tools;

use std::collections::BTreeMap;
use std::fs;
use std::sync::Arc;

use http_support::{Fake, Mode, Reply, Running, SAMPLE, send, start, wait_for};
use molmesh::surface::CpuBackend;
use serde_json::Value;

type Address = [usize; 4];

fn server() -> Running {
    start(Arc::new(CpuBackend::new(Some(2)).unwrap()), |_| {})
}

/// Uploads the sample and returns its path.
fn uploaded(server: &Running) -> String {
    server.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned()
}

fn get(server: &Running, path: &str) -> Reply {
    let reply = server.get(path);
    assert_eq!(reply.status, 200, "{path}: {}", String::from_utf8_lossy(&reply.body));
    reply
}

fn filled(template: &Value, [level, x, y, z]: Address) -> String {
    let at = [("{level}", level), ("{x}", x), ("{y}", y), ("{z}", z)];
    let uri =
        at.into_iter().fold(template.as_str().unwrap().to_owned(), |uri, (name, c)| uri.replace(name, &c.to_string()));
    uri.split('#').next().unwrap().to_owned()
}

/// Returns the tiles with content of the subtree at the root.
fn available(subtree: &[u8], levels: usize) -> Vec<Address> {
    let json_bytes = u64::from_le_bytes(subtree[8..16].try_into().unwrap()) as usize;
    let json: Value = serde_json::from_slice(&subtree[24..24 + json_bytes]).unwrap();
    let content = &json["contentAvailability"][0];
    let view = content["bitstream"].as_u64().map(|n| json["bufferViews"][n as usize]["byteOffset"].as_u64().unwrap());
    let has = |i: usize| match view {
        None => content["constant"] == 1,
        Some(offset) => subtree[24 + json_bytes + offset as usize + i / 8] >> (i % 8) & 1 == 1,
    };
    let (mut tiles, mut first) = (Vec::new(), 0);
    for level in 0..levels {
        for morton in (0..8_usize.pow(level as u32)).filter(|morton| has(first + morton)) {
            let c = |axis: usize| (0..level).fold(0, |c, bit| c | (morton >> (3 * bit + axis) & 1) << bit);
            tiles.push([level, c(0), c(1), c(2)]);
        }
        first += 8_usize.pow(level as u32);
    }
    tiles
}

fn json_of(glb: &[u8]) -> Value {
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&glb[20..20 + length]).unwrap()
}

#[test]
fn a_client_finds_all_tiles_of_a_tileset() {
    let server = server();
    let structure = uploaded(&server);
    let query = "resolution=0.25&color=element&atom_ids=true&select=chain%20A%20and%20protein";
    let document = get(&server, &format!("{structure}/tileset.json?{query}"));
    assert_eq!(document.header("content-type"), Some("application/json"));
    let root = &document.json()["root"];
    let tiling = &root["implicitTiling"];
    let levels = tiling["availableLevels"].as_u64().unwrap() as usize;
    assert_eq!((levels, &tiling["subtreeLevels"]), (3, &Value::from(3)));
    let spacings: Vec<f64> =
        (0..levels).map(|level| root["geometricError"].as_f64().unwrap() / (1 << level) as f64).collect();
    let subtree = get(&server, &format!("{structure}/{}", filled(&tiling["subtrees"]["uri"], [0; 4])));
    let tiles = available(&subtree.body, levels);
    let (folder, mut paths, mut triangles) = (tempfile::tempdir().unwrap(), Vec::new(), BTreeMap::new());
    for tile in tiles {
        let reply = get(&server, &format!("{structure}/{}", filled(&root["content"]["uri"], tile)));
        assert_eq!(reply.header("content-type"), Some("model/gltf-binary"));
        assert_eq!(reply.header("molmesh-resolution").unwrap().parse(), Ok(spacings[tile[0]]));
        let json = json_of(&reply.body);
        let n: u64 = reply.header("molmesh-triangles").unwrap().parse().unwrap();
        assert_eq!(json["meshes"].is_array(), n > 0, "{tile:?}");
        if n > 0 {
            assert!(json["extensionsUsed"].as_array().unwrap().contains(&"EXT_meshopt_compression".into()));
            let attributes = &json["meshes"][0]["primitives"][0]["attributes"];
            assert!(attributes["COLOR_0"].is_u64() && attributes["_ATOM"].is_u64(), "{attributes}");
        }
        *triangles.entry(tile[0]).or_insert(0) += n;
        let path = folder.path().join(format!("{}.glb", tile.map(|c| c.to_string()).join("-")));
        fs::write(&path, &reply.body).unwrap();
        paths.push(path);
    }
    // Each level is the whole mesh at its spacing, with some skirts.
    for (level, n) in triangles {
        let address = format!("{structure}/report.json?{query}").replace("0.25", &spacings[level].to_string());
        let whole = get(&server, &address).json()["triangles"].as_u64().unwrap();
        assert!(n >= whole && n < whole + whole / 5, "level {level}: {n} of {whole}");
    }
    // Tiles that the surface does not reach are valid as well.
    for valid in tools::gltf_validate(&paths).unwrap_or_default() {
        valid.assert_clean();
    }
}

#[test]
fn the_tileset_of_an_assembly_links_to_those_of_its_units() {
    let server = server();
    let mut text = "REMARK 350 BIOMOLECULE: 1\nREMARK 350 APPLY THE FOLLOWING TO CHAINS: A\n".to_owned();
    for (k, row) in
        ["  0.000000 -1.000000  0.000000", "  1.000000  0.000000  0.000000", "  0.000000  0.000000  1.000000"]
            .into_iter()
            .enumerate()
    {
        text += &format!("REMARK 350   BIOMT{} {:>3}{row}{:>15.5}\n", k + 1, 1, 12.5);
    }
    let atoms = std::str::from_utf8(SAMPLE).unwrap().lines().filter(|line| line.starts_with("ATOM"));
    text.extend(atoms.map(|line| format!("{line}\n")));
    let structure = server.post("/v1/structures", &[], text.as_bytes()).header("location").unwrap().to_owned();
    let query = "assembly=1&resolution=1&color=element&instances=true";
    let document = get(&server, &format!("{structure}/tileset.json?{query}")).json();
    let children = document["root"]["children"].as_array().unwrap();
    assert_eq!(children.len(), 1);
    // The rows are x, -z and y of the operator.
    let columns = [0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 12.5, -12.5, 12.5, 1.0];
    let numbers: Vec<f64> = children[0]["transform"].as_array().unwrap().iter().filter_map(Value::as_f64).collect();
    assert_eq!(numbers, columns);
    let root = document["root"]["content"]["uri"].as_str().unwrap();
    let whole = get(&server, &format!("{structure}/{root}"));
    assert_eq!(whole.header("molmesh-resolution").unwrap().parse().ok(), document["root"]["geometricError"].as_f64());
    assert!(json_of(&whole.body)["extensionsRequired"].as_array().unwrap().contains(&"EXT_mesh_gpu_instancing".into()));
    let uri = children[0]["content"]["uri"].as_str().unwrap();
    assert!(uri.starts_with("tileset.json?") && uri.contains("unit=1") && !uri.contains("instances"), "{uri}");
    let unit = get(&server, &format!("{structure}/{uri}")).json();
    assert_eq!(unit["root"]["geometricError"], children[0]["geometricError"]);
    let tile = get(&server, &format!("{structure}/{}", filled(&unit["root"]["content"]["uri"], [0; 4])));
    // The mesh is that of the atoms in the file.
    let plain =
        get(&server, &format!("{structure}/surface.glb?tile=0/0/0/0&resolution=1&color=element&compress=meshopt"));
    assert_eq!(tile.header("molmesh-triangles"), plain.header("molmesh-triangles"));
    for path in ["tileset.subtree?assembly=1&instances=true", "surface.glb?tile=1/0/0/0&assembly=1&instances=true"] {
        let problem = server.get(&format!("{structure}/{path}")).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], "instances", "{problem}");
    }
    // Root and units have one range of colours.
    let coloured = get(&server, &format!("{structure}/tileset.json?assembly=1&instances=true&color=bfactor")).json();
    let uri = coloured["root"]["children"][0]["content"]["uri"].as_str().unwrap();
    let report = get(&server, &format!("{structure}/report.json?assembly=1&color=bfactor")).json();
    let [low, high] = [0, 1].map(|end| report["color"]["range"][end].as_f64().unwrap());
    assert!(low < high && uri.contains(&format!("color_range={low}%2C{high}&")), "{uri}: {low} {high}");
    let missing = server.get(&format!("{structure}/tileset.json?assembly=1&unit=2")).problem(422, "empty-selection");
    assert!(missing["detail"].as_str().unwrap().contains("one unit in assembly 1"), "{missing}");
}

#[test]
fn tiles_are_stored_and_documents_are_cacheable() {
    let server = server();
    let structure = uploaded(&server);
    let tile = format!("{structure}/surface.glb?tile=0/0/0/0&compress=meshopt");
    let made = get(&server, &tile);
    wait_for("stored", || server.get(&tile).header("server-timing").is_some_and(|timing| timing.contains("hit")));
    let etag = made.header("etag").unwrap().to_owned();
    assert_eq!(server.get(&tile).body, made.body);
    for path in [tile, format!("{structure}/tileset.json"), format!("{structure}/tileset.subtree")] {
        let etag = if path.contains("surface") {
            etag.clone()
        } else {
            get(&server, &path).header("etag").unwrap().to_owned()
        };
        let again = send(server.addr, "GET", &path, &[("if-none-match", &etag)], b"");
        assert_eq!((again.status, again.body.len()), (304, 0), "{path}");
    }
    // Another parameter makes another tileset.
    let etag =
        |query: &str| get(&server, &format!("{structure}/tileset.json?{query}")).header("etag").unwrap().to_owned();
    assert_ne!(etag("resolution=0.5"), etag("resolution=0.25"));
    assert_eq!(etag("compress=meshopt"), etag("resolution=0.5"));
    assert!(!get(&server, &format!("{structure}/tileset.json?compress=none")).text().contains("meshopt"));
}

#[test]
fn a_tile_can_be_an_asynchronous_job() {
    let server = server();
    let accepted = server.post("/v1/meshes?tile=0/0/0/0&compress=meshopt", &[("prefer", "respond-async")], SAMPLE);
    assert_eq!(accepted.status, 202, "{}", accepted.text());
    let job = accepted.header("location").unwrap();
    assert_eq!(server.get(&format!("{job}?wait=50")).json()["status"], "successful");
    let result = server.get(&format!("{job}/result")).header("location").unwrap().to_owned();
    let tile = format!("{}/surface.glb?tile=0/0/0/0&compress=meshopt", uploaded(&server));
    assert_eq!(get(&server, &result).body, get(&server, &tile).body);
}

#[test]
fn parameters_that_do_not_apply_are_rejected() {
    let server = server();
    let structure = uploaded(&server);
    for (path, parameter) in [
        ("tileset.json?split=chain", "split"),
        ("tileset.json?tile=0/0/0/0", "tile"),
        ("tileset.json?simplify=0.1", "simplify"),
        ("tileset.json?quality=high", "quality"),
        ("tileset.json?units=nanometer", "units"),
        ("tileset.json?color=depth", "color"),
        ("tileset.json?radius_offset=-5", "radius_offset"),
        ("tileset.json?check=strict", "check"),
        ("tileset.json?width=100", "width"),
        ("tileset.json?format=stl", "format"),
        ("tileset.json?colour=chain", "colour"),
        ("tileset.subtree?tile=1/0/0/0", "tile"),
        ("tileset.subtree?tile=9/0/0/0", "tile"),
        ("surface.glb?tile=0/0/0/0&exact=true&surface=sas", "exact"),
        ("surface.glb?tile=0/0/0/1", "tile"),
        ("surface.glb?tile=0/0/0", "tile"),
        ("surface.glb?tile=00/0/0/0", "tile"),
        ("surface.glb?tile=1/-1/0/0", "tile"),
        ("surface.glb?tile=24/0/0/0", "tile"),
        ("surface.glb?tile=9/0/0/0", "tile"),
        ("surface.png?tile=0/0/0/0", "tile"),
    ] {
        let problem = server.get(&format!("{structure}/{path}")).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], parameter, "{path}: {problem}");
        // The value is that of the address.
        let given = path.split(&format!("{parameter}=")).nth(1).map(|rest| rest.split('&').next().unwrap());
        let value = problem["value"].as_str().unwrap_or(given.unwrap_or_default());
        assert!(given.is_none_or(|given| value == given), "{path}: {problem}");
    }
    // The documentation lists none of them.
    let description = server.get("/openapi.json").json();
    let resolved = |parameter: &Value| match parameter["$ref"].as_str() {
        Some(reference) => description.pointer(reference.trim_start_matches('#')).unwrap()["name"].clone(),
        None => parameter["name"].clone(),
    };
    let operation = &description["paths"]["/v1/pdb/{id}/tileset.json"]["get"]["parameters"];
    let listed: Vec<Value> = operation.as_array().unwrap().iter().map(resolved).collect();
    assert!(listed.contains(&"resolution".into()) && listed.contains(&"assembly".into()), "{listed:?}");
    for name in ["split", "simplify", "units", "tile", "width", "format", "validation", "paper_b"] {
        assert!(!listed.contains(&name.into()), "{name}");
    }
    let estimate = server.post("/v1/estimate?tile=0/0/0/0", &[], SAMPLE).json();
    assert_eq!((&estimate["parameter"], &estimate["status"]), (&"tile".into(), &400.into()), "{estimate}");
    let unknown = structure.replace(structure.rsplit('/').next().unwrap(), &"0".repeat(64));
    server.get(&format!("{unknown}/tileset.json")).problem(404, "no-such-structure");
    server.get(&format!("{structure}/tileset.json?select=ligand")).problem(422, "empty-selection");
}

#[test]
fn a_tileset_of_an_entry_is_that_of_its_file() {
    let archive = tempfile::tempdir().unwrap();
    fs::write(archive.path().join("4pti.pdb"), SAMPLE).unwrap();
    let server = start(Fake::new(Mode::Octahedra), |c| c.archive.dir = Some(archive.path().to_owned()));
    let structure = uploaded(&server);
    for file in ["tileset.json", "tileset.subtree?tile=0/0/0/0"] {
        assert_eq!(
            get(&server, &format!("/v1/pdb/4pti/{file}")).body,
            get(&server, &format!("{structure}/{file}")).body
        );
    }
    server.get("/v1/pdb/9zzz/tileset.json").problem(404, "not-in-archive");
}

#[test]
fn a_tileset_larger_than_the_cache_is_rejected() {
    let fake = |bytes| {
        start(Fake::new(Mode::Octahedra), move |c| {
            (c.limits.structure_cache_bytes, c.limits.scratch_bytes) = (bytes, 0);
        })
    };
    for (bytes, fits) in [(0, false), (10_000, false), (1 << 20, true)] {
        let server = fake(bytes);
        let structure = uploaded(&server);
        for path in ["tileset.json", "surface.glb?tile=0/0/0/0"] {
            let reply = server.get(&format!("{structure}/{path}"));
            if fits {
                assert_eq!(reply.status, 200);
            } else {
                let problem = reply.problem(422, "too-much-memory");
                assert_eq!(problem["limit"], bytes, "{problem}");
                assert!(problem["detail"].as_str().unwrap().contains("limits.structure_cache_bytes"), "{problem}");
            }
        }
    }
}

/// Returns an mmCIF file of `n` atoms on a lattice, in chains of 1,000, with an assembly of `copies`.
fn lattice(n: usize, copies: usize) -> String {
    let mut text = "data_x\nloop_\n".to_owned();
    for item in ["type_symbol", "label_atom_id", "label_comp_id", "label_asym_id", "label_seq_id"] {
        text += &format!("_atom_site.{item}\n");
    }
    text += "_atom_site.Cartn_x\n_atom_site.Cartn_y\n_atom_site.Cartn_z\n";
    for i in 0..n {
        let [x, y, z] = [i % 50, i / 50 % 50, i / 2500].map(|c| 2 * c);
        text += &format!("C CA ALA A{} {} {x}.125 {y}.25 {z}.5\n", i / 1000, i % 1000 + 1);
    }
    let chains: Vec<String> = (0..n.div_ceil(1000)).map(|chain| format!("A{chain}")).collect();
    text += &format!(
        "_pdbx_struct_assembly_gen.assembly_id 1\n_pdbx_struct_assembly_gen.oper_expression '1-{copies}'\n\
         _pdbx_struct_assembly_gen.asym_id_list {}\nloop_\n_pdbx_struct_oper_list.id\n",
        chains.join(",")
    );
    for row in 1..4 {
        (1..4).for_each(|k| text += &format!("_pdbx_struct_oper_list.matrix[{row}][{k}]\n"));
        text += &format!("_pdbx_struct_oper_list.vector[{row}]\n");
    }
    (1..=copies).for_each(|copy| text += &format!("{copy} 1 0 0 {} 0 1 0 0 0 0 1 0\n", 100 * copy));
    text
}

#[test]
fn a_tileset_larger_than_the_cache_is_on_disk() {
    // Less than the memory of reading a block.
    const CACHE: u64 = 1 << 20;
    let started = |cache: u64, scratch: u64| {
        start(Arc::new(CpuBackend::new(Some(2)).unwrap()), move |c| {
            (c.limits.structure_cache_bytes, c.limits.scratch_bytes) = (cache, scratch);
        })
    };
    let upload = |server: &Running, text: &str| {
        server.post("/v1/structures", &[], text.as_bytes()).header("location").unwrap().to_owned()
    };
    let disk = |server: &Running| server.metric("molmesh_scratch_bytes", &[]);
    let (in_memory, on_disk) = (started(512 << 20, 1 << 30), started(CACHE, 1 << 30));
    // The second file is small, and its assembly is as large as the first.
    for (text, query) in [(lattice(200_000, 1), ""), (lattice(2000, 100), "&assembly=1")] {
        let before = disk(&on_disk);
        let structures = [&in_memory, &on_disk].map(|server| upload(server, &text));
        let query = format!("select=all&resolution=1.5&compress=meshopt{query}");
        for path in
            ["tileset.json?", "tileset.subtree?tile=0/0/0/0&", "surface.glb?tile=0/0/0/0&", "surface.glb?tile=1/0/0/0&"]
        {
            let [expected, found] = [(&in_memory, 0), (&on_disk, 1)]
                .map(|(server, i)| get(server, &format!("{}/{path}{query}", structures[i])));
            assert!(expected.body.len() > 100 && found.body == expected.body, "{path}{query}");
        }
        let used = disk(&on_disk) - before;
        assert!(used >= 48.0 * 200_000.0, "{used}");
        // From now on, a request that loads the file finds it damaged.
        let stored = on_disk.dir.path().join("store/inputs").join(structures[1].rsplit('/').next().unwrap());
        fs::write(stored, vec![b' '; text.len()]).unwrap();
        let tile = get(&on_disk, &format!("{}/surface.glb?tile=1/0/1/0&{query}", structures[1]));
        // Neither the index nor an attempt in memory is repeated.
        let times = tile.header("server-timing").unwrap();
        assert!(!["read;dur", "select;dur", "index;dur"].iter().any(|stage| times.contains(stage)), "{times}");
        get(&on_disk, &format!("{}/tileset.subtree?{query}", structures[1]));
    }
    // An index that does not fit beside another one replaces it, and one that never fits is rejected.
    let text = lattice(200_000, 1);
    let narrow = started(CACHE, 18_000_000);
    let (structure, before) = (upload(&narrow, &text), disk(&narrow));
    for color in ["element", "chain", "element"] {
        get(&narrow, &format!("{structure}/tileset.json?select=all&resolution=4&color={color}"));
        assert!((9_600_000.0..18_000_000.0).contains(&(disk(&narrow) - before)), "{}", disk(&narrow));
    }
    // An index on disk cannot have these parameters.
    let repeated = upload(&narrow, &lattice(30_000, 2));
    for (query, parameter) in [("assembly=1&unit=1", "`unit`"), ("color=bfactor", "`color`")] {
        let path = format!("{repeated}/tileset.json?select=all&resolution=4&{query}");
        let problem = narrow.get(&path).problem(422, "too-much-memory");
        assert!(problem["detail"].as_str().unwrap().contains(parameter), "{problem}");
    }
    drop((on_disk, narrow));
    for (scratch, place) in [(1_000_000, "limits.scratch_bytes"), (0, "limits.structure_cache_bytes")] {
        let server = started(CACHE, scratch);
        let path = format!("{}/tileset.json?select=all&resolution=4", upload(&server, &text));
        let problem = server.get(&path).problem(422, "too-much-memory");
        assert_eq!(problem["limit"], if scratch == 0 { CACHE } else { scratch }, "{problem}");
        assert!(problem["detail"].as_str().unwrap().contains(place), "{problem}");
    }
}

#[test]
fn a_tileset_in_memory_is_not_prepared_again() {
    let server = server();
    let structure = uploaded(&server);
    let digest = structure.rsplit('/').next().unwrap();
    let tile = |tile: &str| server.get(&format!("{structure}/surface.glb?tile={tile}&resolution=0.25"));
    let first = tile("0/0/0/0");
    assert!(first.header("server-timing").unwrap().contains("index;dur"), "{first:?}");
    // From now on, a request that loads the file finds it damaged.
    let stored = server.dir.path().join("store/inputs").join(digest);
    fs::write(stored, vec![b' '; SAMPLE.len()]).unwrap();
    // Neither another tile nor another encoding or colour needs another index.
    for query in ["", "&compress=meshopt", "&atom_ids=true&normals=none", "&color=element", "&color=chain"] {
        let second = tile(&format!("1/0/0/0{query}"));
        assert_eq!(second.status, 200, "{query}");
        assert!(!second.header("server-timing").unwrap().contains("index;dur"), "{query}: {second:?}");
    }
    assert_eq!(tile("1/0/0/0&color=bfactor").status, 200);
}
