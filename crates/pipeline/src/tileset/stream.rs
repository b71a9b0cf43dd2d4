//! Tileset of a structure that is read as a stream, with an index of its atoms on disk. Memory depends on a tile and on
//! a block of a file, not on the structure.

use std::collections::BTreeSet;
use std::io::Read;
use std::sync::Arc;

use molmesh_formats::tileset::TileAddress;
use molmesh_structure::stream::{Block, Blocks, ScratchFile, StoredBytes, check_positions};
use molmesh_structure::{
    Assemblies, AssemblyRules, Placements, ReadLimits, SelectedBlocks, SelectedOfBlock, Structure,
};
use molmesh_surface::clip::influence_of;
use molmesh_surface::{Control, MemoryMeter as _, Reservation, Spheres, SurfaceError, SurfaceParams};

use super::Tileset;
use super::layout::{CELLS, Layout};
use super::level::{GROUP_ABOVE, MIN_BUCKET, bucket_side, cube, group_of};
use super::source::{LevelSource, Streamed};
use super::stored::{SphereIndex, SphereList, StoredSphere};
use crate::color::{BlockColors, Scheme};
use crate::load::SPHERE_BYTES;
use crate::params::ParamError;
use crate::{JobError, Options, WorkScope};

/// Buffer of the index, in blocks.
const BUFFERED_BLOCKS: usize = 4;
/// Memory of selecting and colouring an atom of a block, bytes.
const SELECT_BYTES: u64 = 20 + SPHERE_BYTES;
/// Memory of an atom while it is grouped, bytes.
const SORT_BYTES: u64 = 40;
/// Number of coordinates of groups along an axis, a power of two: spacings are above 2.5 Å.
const MAX_CELLS: u64 = 1 << 18;

/// Atoms of a structure.
pub enum StreamSource<'a> {
    /// Contents of the files that form one structure, in order.
    Files(Vec<Box<dyn Read + Send + 'a>>),
    /// Structure in memory, whose assembly need not fit. It is copied.
    Structure(&'a Structure),
}

/// Structure that is indexed on disk.
pub struct StructureStream<'a> {
    /// Source of the atoms.
    pub source: StreamSource<'a>,
    /// File for the index; and file for large columns of BinaryCIF and the atoms of an assembly, which is removed when
    /// the index is complete.
    pub scratch: [ScratchFile; 2],
    /// Bytes of a block of text.
    pub block_bytes: usize,
    /// Called with the number of each file before it is read.
    pub began: &'a dyn Fn(usize),
}

/// Rejects parameters of a job that need the whole structure in memory, or do not apply to several files.
///
/// # Errors
/// Returns [`ParamError::BadValue`].
pub fn check_stream(options: &Options, n_files: usize) -> Result<(), ParamError> {
    match needs_memory(options, n_files) {
        Some((name, value, expected)) => {
            let expected = format!("{expected} with `--scratch`, which reads the structure as a stream");
            Err(ParamError::bad_value(name, &value, expected))
        }
        None => Ok(()),
    }
}

/// Finds a parameter that [`check_stream`] rejects. Returns its name, its value and the expected value.
#[must_use]
pub fn needs_memory(options: &Options, n_files: usize) -> Option<(&'static str, String, &'static str)> {
    let selection = &options.selection;
    let of_range = |scheme| matches!(scheme, Scheme::BFactor | Scheme::Occupancy);
    let when = |is_refused: bool, value: String| is_refused.then_some(value);
    let color = options.color.map(|color| (color.scheme, color.range.is_some()));
    let refused = [
        ("select", when(selection.atoms.has_within(), selection.atoms.to_string()), "an expression without `within`"),
        ("assembly", selection.assembly.clone().filter(|_| n_files > 1), "no value for several files, or one file"),
        ("instances", when(selection.instances, "true".to_owned()), "false"),
        ("unit", selection.unit.map(|unit| unit.to_string()), "no value"),
        ("detail", options.spacing.detail().map(|level| level.to_string()), "a `resolution` instead"),
        (
            "color",
            color.filter(|(scheme, has_range)| of_range(*scheme) && !has_range).map(|(scheme, _)| scheme.to_string()),
            "a `color_range` beside it",
        ),
        (
            "color",
            color.filter(|(scheme, _)| *scheme == Scheme::Plddt).map(|(scheme, _)| scheme.to_string()),
            "another scheme, such as `bfactor` with a `color_range`",
        ),
    ];
    refused.into_iter().find_map(|(name, value, expected)| Some((name, value?, expected)))
}

/// Spheres of the blocks so far.
enum ReadSpheres {
    /// Index of all spheres.
    Index(SphereIndex),
    /// Atoms of the file in which an assembly is found, with the number of their chain as their order.
    Distinct(SphereList),
}

/// Reader of the blocks of a stream.
struct BlockReader<'a> {
    options: &'a Options,
    limits: &'a ReadLimits,
    selected: SelectedBlocks,
    colors: Option<BlockColors>,
    spheres: ReadSpheres,
    /// Description of the first file, without its atoms, and the source of its radii.
    head: Option<(Structure, &'static str)>,
    /// Assemblies of the latest file; a job with an assembly has one file.
    assemblies: Assemblies,
    /// Memory of `assemblies`.
    memory: Reservation,
}

impl BlockReader<'_> {
    /// Adds the atoms of the file `input`. Reads blocks of about `block_bytes`, with large columns in `columns`.
    fn read(
        &mut self,
        input: Box<dyn Read + Send + '_>,
        block_bytes: usize,
        columns: &Arc<StoredBytes>,
        WorkScope { clock, control }: &WorkScope<'_>,
    ) -> Result<(), JobError> {
        self.selected.begin_file();
        let needs_secondary = self.options.color.is_some_and(|color| color.scheme == Scheme::SecondaryStructure);
        let open = || Blocks::new(input, block_bytes, needs_secondary, columns, self.limits, control);
        let mut blocks = clock.time("read", open)?;
        loop {
            // Releases the memory of the block.
            let block_control = control.metered();
            let Some(mut block) = clock.time("read", || blocks.next(&block_control))? else { break };
            clock.time("select", || self.add(&mut block, &block_control))?;
        }
        self.assemblies = blocks.take_assemblies();
        self.memory = Reservation::new(&control.memory);
        self.memory.grow(self.assemblies.bytes()).map_err(SurfaceError::from)?;
        Ok(())
    }

    /// Adds the atoms of a block.
    fn add(&mut self, block: &mut Block, control: &Control<'_>) -> Result<(), JobError> {
        control.memory.grow(SELECT_BYTES * block.len as u64).map_err(SurfaceError::from)?;
        let first = self.selected.n_atoms;
        let SelectedOfBlock { atoms, chains } =
            self.selected.add(block, &self.options.selection, self.limits, control)?;
        let structure = &block.structure;
        let colors = self.colors.as_mut().map(|colors| colors.add(structure, &atoms, &chains)).transpose()?;
        let column = |column: &[f64]| atoms.iter().map(|&i| column[i as usize]).collect();
        let radii = atoms.iter().map(|&i| structure.vdw_radius(i as usize)).collect();
        let spheres = Spheres::new(column(&structure.x), column(&structure.y), column(&structure.z), radii)?;
        for (row, i) in atoms.iter().enumerate() {
            // The number of atoms is limited to 32 bits.
            let atom = u32::try_from(first + u64::from(*i)).unwrap_or(u32::MAX);
            let (centre, radius, order) = (spheres.centre(row), spheres.radius(row), chains[row].into());
            let color = colors.as_ref().map_or([0; 4], |colors| colors[row]);
            let sphere = StoredSphere { centre, order, radius, atom, color, padding: 0 };
            match &mut self.spheres {
                ReadSpheres::Index(index) => index.push(sphere)?,
                ReadSpheres::Distinct(list) => list.push(sphere)?,
            }
        }
        if self.head.is_none() {
            let radii = block.structure.radii_name();
            self.head = Some((block.take_description(), radii));
        }
        Ok(())
    }
}

impl Tileset<Box<Structure>> {
    /// Prepares the levels of the structure in a stream. The grid spacing of `options` is that of the last level.
    ///
    /// # Errors
    /// Returns a [`JobError`] if reading or selecting fails, there are too many tiles, the index cannot be written, or
    /// the job is cancelled.
    pub fn of_stream(
        stream: StructureStream<'_>,
        options: &Options,
        limits: &ReadLimits,
        scope: &WorkScope<'_>,
    ) -> Result<Self, JobError> {
        let WorkScope { clock, control } = scope;
        let params = SurfaceParams { atom_ids: options.needs_atoms(), ..options.params.clone() };
        let [file, columns] = stream.scratch.map(|file| Arc::new(StoredBytes::new(file)));
        let mut side = bucket_side(CELLS * params.resolution);
        while side >= 2.0 * MIN_BUCKET {
            side *= 0.5;
        }
        let buffer = BUFFERED_BLOCKS * stream.block_bytes;
        let new_index = || SphereIndex::new(&file, side, buffer, control);
        let is_assembly = options.selection.assembly.is_some();
        let spheres = if is_assembly {
            ReadSpheres::Distinct(SphereList::new(&columns, control)?)
        } else {
            ReadSpheres::Index(new_index()?)
        };
        let (selected, colors) =
            (SelectedBlocks::new(control), options.color.map(|coloring| BlockColors::new(coloring, control)));
        let (assemblies, memory) = (Assemblies::default(), Reservation::new(&control.memory));
        let mut reader = BlockReader { options, limits, selected, colors, spheres, head: None, assemblies, memory };
        match stream.source {
            StreamSource::Files(files) => {
                for (number, input) in files.into_iter().enumerate() {
                    (stream.began)(number);
                    reader.read(input, stream.block_bytes, &columns, scope)?;
                }
            }
            StreamSource::Structure(structure) => {
                let mut block = Block { len: structure.len(), structure: structure.clone() };
                reader.assemblies = std::mem::take(&mut block.structure.assemblies);
                let block_control = control.metered();
                clock.time("select", || reader.add(&mut block, &block_control))?;
            }
        }
        let BlockReader { selected, colors, spheres, head, assemblies, memory: _memory, .. } = reader;
        let atoms_in_file = selected.n_in_files();
        let assembly = match &options.selection.assembly {
            Some(id) => Some(AssemblyRules::find(&assemblies, &selected.chain_names(), id, control)?),
            None => None,
        };
        let n_of_chains = selected.n_of_chains();
        let mut selected = selected.finish(&options.selection, assembly.as_ref())?;
        let placements = assembly.map(|assembly| assembly.placements(&n_of_chains, limits, control)).transpose()?;
        let groups = placements.as_ref().map_or_else(|| vec![0], Placements::chains);
        let colors = colors.map(|colors| colors.finish(groups.into_iter())).transpose()?;
        let Some((structure, radii)) = head else { return Err(SurfaceError::NoSpheres.into()) };
        clock.time("index", || {
            let index = match (spheres, &placements) {
                (ReadSpheres::Index(index), _) => index,
                (ReadSpheres::Distinct(list), Some(placements)) => {
                    let mut index = new_index()?;
                    place(list, placements, &mut index, control)?;
                    selected.copies = placements.copies();
                    index
                }
                // Atoms are listed for an assembly only.
                (ReadSpheres::Distinct(_), None) => return Err(SurfaceError::NoSpheres.into()),
            };
            let index = Arc::new(index.finish()?);
            check_duplicates(&index, limits, control)?;
            params.check_radius(index.radii[0])?;
            let layout = Layout::new(index.bounds, influence_of(index.radii[1], &params), params.resolution);
            let (levels, tiles) = layout.index_of(&index, &file, buffer, &params, control)?;
            let streamed = Some(Streamed { n_atoms: index.len, atoms_in_file, radii, colors });
            Ok(Self { structure: Box::new(structure), layout, levels, tiles, selected, streamed })
        })
    }
}

/// Adds the copies of atoms that form an assembly to an index. Their order is that of the copies, then of the chains.
fn place(
    list: SphereList,
    placements: &Placements,
    index: &mut SphereIndex,
    control: &Control<'_>,
) -> Result<(), JobError> {
    let by_chain = placements.copies_by_chain();
    list.each_run(|spheres| {
        for chain in spheres.chunk_by(|a, b| a.order == b.order) {
            let number = chain[0].order;
            let copies = usize::try_from(number).ok().and_then(|number| by_chain.get(number));
            for copy in copies.into_iter().flatten().cloned().flatten() {
                control.check()?;
                let operator = &placements.operators[copy];
                let moved: Vec<[f64; 3]> = chain.iter().map(|sphere| operator.apply(sphere.centre)).collect();
                let column = |k: usize| moved.iter().map(|at| at[k]).collect();
                // Rejects coordinates out of range.
                let radii = chain.iter().map(|sphere| sphere.radius).collect();
                let moved = Spheres::new(column(0), column(1), column(2), radii)?;
                for (row, sphere) in chain.iter().enumerate() {
                    let order = (copy as u64) << 32 | number;
                    index.push(StoredSphere { centre: moved.centre(row), order, ..*sphere })?;
                }
            }
        }
        Ok(())
    })
}

/// Rejects meshed atoms of which more than allowed have the same position.
fn check_duplicates(index: &SphereIndex, limits: &ReadLimits, control: &Control<'_>) -> Result<(), JobError> {
    for cubes in index.by_cell(0.0) {
        let (spheres, _memory) = index.read(&cubes, control)?;
        check_positions(spheres.len(), |i| spheres[i].centre, limits, control)?;
    }
    Ok(())
}

/// Returns the number of a group among all groups of a level with the grid spacing `spacing`, Å: as in memory, cell by
/// cell of a coarser grid.
fn order_of(group: [i64; 3], spacing: f64, side: f64) -> u64 {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a power of two, at most 64")]
    let ratio = (side / spacing).max(1.0).round() as u64;
    let half = (MAX_CELLS / 2).cast_signed();
    let at = group.map(|c| (c + half).cast_unsigned());
    let join = |at: [u64; 3], n: u64| (at[0] * n + at[1]) * n + at[2];
    join(at.map(|c| c / ratio), MAX_CELLS / ratio) * ratio.pow(3) + join(at.map(|c| c % ratio), ratio)
}

/// Returns the spheres of a level whose tiles have the edge length `side`, Å: one for all atoms in a cell of its grid.
fn grouped(
    atoms: &SphereIndex,
    mut groups: SphereIndex,
    params: &SurfaceParams,
    spacing: f64,
    control: &Control<'_>,
) -> Result<SphereIndex, JobError> {
    let side = bucket_side(CELLS * params.resolution);
    for cubes in atoms.by_cell(spacing) {
        let (mut spheres, _memory) = atoms.read(&cubes, control)?;
        let cell = |sphere: &StoredSphere| cube(sphere.centre, spacing);
        let _sorting = control.reserve(SORT_BYTES * spheres.len() as u64).map_err(SurfaceError::from)?;
        spheres.sort_by_cached_key(|sphere| (cell(sphere), sphere.key()));
        for group in spheres.chunk_by(|a, b| cell(a) == cell(b)) {
            let atom = |i: usize| (group[i].centre, group[i].radius);
            let (centre, radius, nearest) = group_of(group.len(), atom, params, spacing);
            let order = order_of(cell(&group[0]), spacing, side);
            groups.push(StoredSphere { centre, order, radius, ..group[nearest] })?;
        }
    }
    groups.finish()
}

impl Layout {
    /// Returns the levels, coarsest first, and the tiles that the surface of the atoms can reach, with their ancestors.
    fn index_of(
        &self,
        atoms: &Arc<SphereIndex>,
        file: &Arc<StoredBytes>,
        buffer: usize,
        params: &SurfaceParams,
        control: &Control<'_>,
    ) -> Result<(Vec<LevelSource>, BTreeSet<TileAddress>), JobError> {
        let (mut levels, mut tiles) = (Vec::new(), BTreeSet::new());
        for number in (0..self.levels).rev() {
            let spacing = self.spacing(number);
            let level = if spacing <= GROUP_ABOVE {
                Arc::clone(atoms)
            } else {
                let groups = SphereIndex::new(file, self.side(number), buffer, control)?;
                Arc::new(grouped(atoms, groups, params, spacing, control)?)
            };
            let reach = influence_of(level.radii[1], params);
            Self::add_parents(number, &mut tiles);
            for cubes in level.by_cell(0.0) {
                let (spheres, _memory) = level.read(&cubes, control)?;
                let centres = spheres.iter().map(|sphere| sphere.centre);
                self.add_tiles(number, centres, reach, params, &mut tiles, control)?;
            }
            level.keep_memory();
            levels.push(LevelSource::File(level));
        }
        levels.reverse();
        Ok((levels, tiles))
    }
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use std::collections::BTreeMap;
    use std::fmt::Write as _;
    use std::sync::Mutex;

    use molmesh_structure::read;
    use molmesh_surface::CpuBackend;

    use super::super::{TilesetReport, write, write_stream};
    use super::*;
    use crate::{Choice, JobLimits, StageClock, params};

    const HEAD: &str = "data_x\n_struct.title 'Several copies'\nloop_\n_entity.id\n_entity.type\n1 polymer\n2 water\n\
                        loop_\n_struct_asym.id\n_struct_asym.entity_id\n";
    const ITEMS: [&str; 15] = [
        "group_PDB",
        "type_symbol",
        "label_atom_id",
        "label_alt_id",
        "label_comp_id",
        "label_asym_id",
        "auth_asym_id",
        "auth_seq_id",
        "label_seq_id",
        "Cartn_x",
        "Cartn_y",
        "Cartn_z",
        "occupancy",
        "B_iso_or_equiv",
        "pdbx_PDB_model_num",
    ];

    /// Returns the head and the rows of copies of the sample, which are 60 Å apart, and the row of a distant ion.
    fn copies(n: usize) -> (String, Vec<String>) {
        let s = read(include_bytes!("../../../../samples/4pti.pdb"), &ReadLimits::default()).unwrap();
        let chain = |copy: usize| ["B", "A", "Z", "Q", "C"][copy % 5].to_owned() + &(copy / 5).to_string();
        let (mut head, mut rows) = (HEAD.to_owned(), Vec::new());
        for copy in 0..n {
            write!(head, "{0} 1\n{0}w 2\n", chain(copy)).unwrap();
            for i in 0..s.len() {
                let (group, name) = (if s.hetero[i] { "HETATM" } else { "ATOM" }, s.name.get(i));
                let label = chain(copy) + if s.hetero[i] { "w" } else { "" };
                let (x, y, z) = (s.x[i] + 60.0 * copy as f64, s.y[i] + 25.0 * (copy % 2) as f64, s.z[i]);
                let altloc = if s.residue_number[i] == 20 && i % 2 == 0 { "A" } else { "." };
                rows.push(format!(
                    "{group} {} {name} {altloc} {} {label} {} {} . {x:.3} {y:.3} {z:.3} {} {} 1\n",
                    molmesh_structure::element::symbol(s.element[i]),
                    s.residue.get(i),
                    chain(copy),
                    s.residue_number[i],
                    s.occupancy[i],
                    s.b_factor[i],
                ));
            }
        }
        rows.push("HETATM NA NA . NA I I 1 . -150.3 90.2 33.3 1 20 1\n".to_owned());
        head.push_str("loop_\n");
        ITEMS.iter().for_each(|item| writeln!(head, "_atom_site.{item}").unwrap());
        (head, rows)
    }

    type Written = (BTreeMap<String, Vec<u8>>, TilesetReport);

    fn options(query: &[(&str, &str)]) -> Options {
        let all = query.iter().copied().chain([("compress", "meshopt")]);
        params::parse(all).unwrap().options
    }

    fn choice(backend: &CpuBackend) -> Choice<'_> {
        Choice { backend, reason: "test" }
    }

    /// Returns the files of the tileset of a structure in memory.
    fn in_memory(text: &str, options: &Options) -> Written {
        let (files, limits, control) = (Mutex::default(), JobLimits::default(), Control::default());
        let store = |path: &str, bytes: &[u8]| {
            let files: &Mutex<BTreeMap<_, _>> = &files;
            files.lock().unwrap().insert(path.to_owned(), bytes.to_owned());
            Ok(())
        };
        let read = |_: &Control<'_>| read(text.as_bytes(), &limits.read).map(Box::new);
        let report = write(read, options, &choice(&CpuBackend::default()), &limits, &control, &(), store).unwrap();
        (files.into_inner().unwrap(), report)
    }

    fn scratch() -> [ScratchFile; 2] {
        [(); 2].map(|()| ScratchFile { file: tempfile::tempfile().unwrap(), meter: Arc::new(()) })
    }

    /// Returns the files of the tileset of a stream.
    fn streamed(texts: &[&str], block_bytes: usize, options: &Options) -> Result<Written, String> {
        check_stream(options, texts.len()).map_err(|error| error.to_string())?;
        let (files, limits, control) = (Mutex::default(), JobLimits::default(), Control::default());
        let store = |path: &str, bytes: &[u8]| {
            let files: &Mutex<BTreeMap<_, _>> = &files;
            files.lock().unwrap().insert(path.to_owned(), bytes.to_owned());
            Ok(())
        };
        let inputs = texts.iter().map(|text| Box::new(text.as_bytes()) as Box<dyn Read + Send>).collect();
        let stream =
            StructureStream { source: StreamSource::Files(inputs), scratch: scratch(), block_bytes, began: &|_| {} };
        let written = write_stream(stream, options, &choice(&CpuBackend::default()), &limits, &control, &(), store);
        let report = written.map_err(|error| error.to_string())?;
        Ok((files.into_inner().unwrap(), report))
    }

    fn assert_same(found: &Written, expected: &Written, what: &str) {
        let names = |written: &Written| written.0.keys().cloned().collect::<Vec<_>>();
        assert_eq!(names(found), names(expected), "{what}");
        let differing: Vec<_> = expected.0.iter().filter(|(name, bytes)| found.0[*name] != **bytes).collect();
        assert!(differing.is_empty(), "{what}: {:?}", differing.iter().map(|(name, _)| name).collect::<Vec<_>>());
        let report = |written: &Written| serde_json::to_string(&written.1).unwrap();
        assert_eq!(report(found), report(expected), "{what}");
    }

    #[test]
    fn a_stream_gives_the_bytes_of_a_structure_in_memory() {
        let (head, rows) = copies(6);
        let text = head + &rows.concat() + "#\n";
        for query in [
            &[("resolution", "2"), ("color", "chain"), ("atom_ids", "true")][..],
            &[("resolution", "2"), ("color", "entity"), ("select", "all")],
            &[("resolution", "4"), ("color", "residue"), ("surface", "ses")],
            &[("resolution", "1"), ("color", "element"), ("chains", "A0,C0"), ("altloc", "A")],
            &[("resolution", "3"), ("color", "bfactor"), ("color_range", "5,40"), ("select", "byres name CA")],
            // Two values of the legend have the same label.
            &[("resolution", "4"), ("color", "bfactor"), ("color_range", "0,0.004")],
            &[("resolution", "1.5"), ("select", "water or chain B0"), ("radius_offset", "0.2")],
        ] {
            let options = options(query);
            let expected = in_memory(&text, &options);
            assert!(expected.1.levels.len() > 1 && expected.0.len() > 4, "{query:?}");
            for block_bytes in [3000, 20_000, 1 << 24] {
                let found = streamed(&[&text], block_bytes, &options).unwrap();
                assert_same(&found, &expected, &format!("{query:?} {block_bytes}"));
            }
        }
    }

    /// Includes a negative control: files without one atom.
    #[test]
    fn several_files_are_one_structure() {
        let (head, rows) = copies(5);
        let options = options(&[("resolution", "2"), ("color", "chain"), ("atom_ids", "true"), ("select", "all")]);
        let expected = in_memory(&(head.clone() + &rows.concat()), &options);
        let file = |rows: &[String]| head.clone() + &rows.concat();
        let third = rows.len() / 5;
        let files = [file(&rows[..third]), file(&rows[third..3 * third]), file(&rows[3 * third..])];
        let texts = || files.iter().map(String::as_str).collect::<Vec<_>>();
        assert_same(&streamed(&texts(), 5000, &options).unwrap(), &expected, "three files");
        let short = file(&rows[3 * third + 1..]);
        let found = streamed(&[&files[0], &files[1], &short], 5000, &options).unwrap();
        assert_ne!(found.0, expected.0);
        assert_eq!(found.1.atoms + 1, expected.1.atoms);
        // The order of the files determines colours and indices.
        let found = streamed(&[&files[1], &files[0], &files[2]], 5000, &options).unwrap();
        assert_ne!(found.0, expected.0);
    }

    /// Categories of an assembly whose rules have another order than the chains of [`copies`].
    const ASSEMBLY: &str = "loop_\n_pdbx_struct_assembly.id\n_pdbx_struct_assembly.details\n1 'a_b'\nloop_\n\
        _pdbx_struct_assembly_gen.assembly_id\n_pdbx_struct_assembly_gen.details\n\
        _pdbx_struct_assembly_gen.oper_expression\n_pdbx_struct_assembly_gen.asym_id_list\n\
        1 .\n;(1-3)\n;\n Z0,A0w\n2 . 1 A0\n1 '; x' 'P,2'\n;B0,Z0,\nB0w,none\n;\n";
    const OPERATORS: &str = "loop_\n_pdbx_struct_oper_list.id\n";

    /// Returns the rows of translations 1 to 3, and of `P`, a turn about z.
    fn operators() -> String {
        let mut text = OPERATORS.to_owned();
        for row in 1..4 {
            (1..4).for_each(|k| writeln!(text, "_pdbx_struct_oper_list.matrix[{row}][{k}]").unwrap());
            writeln!(text, "_pdbx_struct_oper_list.vector[{row}]").unwrap();
        }
        (1..4).for_each(|n| writeln!(text, "{n} 1 0 0 {} 0 1 0 0 0 0 1 {n}", 70 * n - 70).unwrap());
        text + "P 0 -1 0 0 1 0 0 50 0 0 1 -90.5\n"
    }

    #[test]
    fn an_assembly_may_precede_or_follow_the_atoms() {
        let (head, rows) = copies(6);
        // The second chain begins before the first one.
        let second = (rows.len() - 1) / 6;
        let (before, after) = rows.split_at(second + 200);
        let rows: Vec<String> = after[..200].iter().chain(before).chain(&after[200..]).cloned().collect();
        let (atoms, rest) = (rows.concat(), "_x.y 'a' # _entity.id\n_x.z 2\n");
        let (name, head) = head.split_at("data_x\n".len());
        let texts = [
            format!("{name}{ASSEMBLY}{}{head}{atoms}{rest}", operators()),
            format!("{name}{}{head}{atoms}{rest}{ASSEMBLY}_x.zz 2\n", operators()),
            format!("{name}{head}{atoms}{rest}{ASSEMBLY}{}#\ndata_y\n{ASSEMBLY}", operators()),
        ];
        let all = [("assembly", "1"), ("select", "all")];
        for (query, n_atoms) in [
            (&[("resolution", "2"), ("color", "chain"), ("atom_ids", "true")][..], 5 * 454),
            (&[("resolution", "3"), ("color", "entity")], 5 * 454),
            (&[("resolution", "1.5"), ("color", "residue"), ("chains", "A0,B0")], 0),
        ] {
            let query: Vec<(&str, &str)> = all.iter().chain(query).copied().collect();
            let options = options(&query);
            for text in &texts {
                let expected = in_memory(text, &options);
                assert!(expected.1.levels.len() > 1 && expected.1.atoms > n_atoms, "{}", expected.1.atoms);
                for block_bytes in [3000, 20_000, 1 << 24] {
                    let found = streamed(&[text], block_bytes, &options).unwrap();
                    assert_same(&found, &expected, &format!("{query:?} {block_bytes}"));
                }
            }
        }
        // Negative controls: one operator, and the rules twice.
        let single = streamed(&[&texts[0]], 3000, &options(&[("assembly", "2"), ("resolution", "2")])).unwrap();
        assert!(single.1.atoms < 500, "{}", single.1.atoms);
        let other = texts[2].replace("data_y", "");
        let query = options(&[("assembly", "1"), ("resolution", "2")]);
        assert_ne!(in_memory(&other, &query).1.atoms, in_memory(&texts[2], &query).1.atoms);
        assert_same(&streamed(&[&other], 3000, &query).unwrap(), &in_memory(&other, &query), "two tables");
    }

    #[test]
    fn assemblies_are_limited_and_missing_ones_rejected() {
        let (head, rows) = copies(3);
        let text = head + &rows.concat() + ASSEMBLY + &operators();
        let of = |id: &str, limits: &ReadLimits| {
            let options = options(&[("assembly", id), ("resolution", "2")]);
            let stream = StructureStream {
                source: StreamSource::Files(vec![Box::new(text.as_bytes())]),
                scratch: scratch(),
                block_bytes: 5000,
                began: &|_| {},
            };
            let made = Tileset::of_stream(
                stream,
                &options,
                limits,
                &WorkScope::new(&StageClock::new(&()), &Control::default()),
            );
            let expected = molmesh_structure::select_with(
                &read(text.as_bytes(), limits).unwrap(),
                &options.selection,
                limits,
                &Control::default(),
            );
            (made.map(|made| made.n_atoms()).map_err(|error| error.to_string()), expected.map(|all| all.atoms.len()))
        };
        let limits = ReadLimits::default();
        let n = of("1", &limits).1.unwrap() as u64;
        assert_eq!(of("1", &limits).0, Ok(n));
        for (id, limits) in [
            ("3", limits),
            ("1", ReadLimits { max_copies: 4, ..limits }),
            ("1", ReadLimits { max_atoms: n - 1, ..limits }),
        ] {
            let (found, expected) = of(id, &limits);
            assert_eq!(found.unwrap_err(), expected.unwrap_err().to_string());
        }
    }

    #[test]
    fn what_needs_the_whole_structure_is_rejected() {
        let (head, rows) = copies(2);
        let text = head.clone() + &rows.concat();
        let of = |query: &[(&str, &str)]| streamed(&[&text], 3000, &options(query)).unwrap_err();
        for (query, expected) in [
            (&[("select", "within 5 of water")][..], "`select`"),
            (&[("assembly", "1"), ("instances", "true")], "`instances`"),
            (&[("assembly", "1")], "no assemblies"),
            (&[("detail", "2")], "`detail`"),
            (&[("assembly", "1"), ("unit", "1")], "`unit`"),
            (&[("color", "bfactor")], "`color_range`"),
            (&[("color", "plddt")], "`bfactor`"),
            (&[("chains", "A0,X")], "chain `X` is not in the file; it has `A0`, `B0`, `I`"),
            (&[("select", "chain X")], "selected chain `X`"),
            (&[("model", "7")], "model 7 is not in the file; it has 1"),
            (&[("altloc", "B")], "alternative location `B` is not in the file; it has A"),
            (&[("select", "elem Xe")], "the selection holds no atoms"),
            (&[("color", "secondary-structure")], "HELIX"),
        ] {
            let found = of(query);
            assert!(found.contains(expected), "{query:?}: {found}");
        }
        // A residue with alternative locations occurs twice.
        let twice = head + &rows[..1000].concat() + &rows[..400].concat();
        let found = streamed(&[&twice], 3000, &options(&[])).unwrap_err();
        assert!(found.contains("residue 20 of chain `B0`"), "{found}");
    }

    #[test]
    fn groups_have_the_order_of_cells() {
        let (spacing, side) = (4.0, 32.0);
        let mut groups: Vec<[i64; 3]> = (-9..9).flat_map(|x| (-9..9).map(move |y| [x, y, (x * y) % 11])).collect();
        let cell = |group: [i64; 3]| group.map(|c: i64| c.div_euclid(8));
        groups.sort_unstable_by_key(|group| (cell(*group), *group));
        let orders: Vec<u64> = groups.iter().map(|group| order_of(*group, spacing, side)).collect();
        assert!(orders.is_sorted_by(|a, b| a < b));
        assert!(order_of([-40_000; 3], 2.6, 41.6) < order_of([40_000; 3], 2.6, 41.6));
    }
}
