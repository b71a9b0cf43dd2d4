//! Reader of BinaryCIF: the data model of mmCIF as encoded columns in MessagePack. It reads the same items as
//! [`super::mmcif`], with the same meaning ([`super::atom_site`]).
//!
//! Specification: <https://github.com/molstar/BinaryCIF>, version 0.3.
//!
//! Only the required columns are decoded. Declared lengths are not trusted: rows are within the limits before memory is
//! allocated, and columns must have as many values.

mod column;
mod column_stream;
mod decode;
mod encoding;
mod fault;
mod msgpack;
mod payload;
mod row_stream;
mod rows;
mod skeleton;
mod steps;

pub(super) use self::row_stream::RowStream;
pub(super) use self::skeleton::Skeleton;

use molmesh_surface::{Exceeded, Limit, MemoryMeter as _};

use self::column::DecodedColumn;
use self::column_stream::{DecodeLimits, Raw};
use self::fault::Fault;
use self::msgpack::Cursor;
use super::atom_layout::Layout;
use super::atoms::{Columns, Structure};
use super::categories::{self, Categories};
use super::data_blocks::{Passed, SPHERES, UnreadAtoms};
use super::error::StructureError;
use super::kinds::Sequence;
use super::pdb::MAX_TITLE;
use super::read::{ReadLimits, Reading};
use super::source::{SourceFields, SourceFormat};
use super::text::{decode, normalize};

/// Maximum number of columns in a category. The dictionary has about a hundred for `atom_site`.
const MAX_COLUMNS: usize = 1000;
/// Maximum number of texts of a column in a category with fewer rows. Programs that select atoms keep all texts.
const MAX_UNUSED_TEXTS: usize = 1 << 20;

/// Reads the first data block that has atoms with coordinates.
pub(super) fn read(bytes: &[u8], reading: &Reading<'_>) -> Result<Structure, StructureError> {
    structure(Cursor::new(bytes), reading)
}

/// Reads a file whose large byte strings are in the temporary file, as [`read`] does.
pub(super) fn read_skeleton(skeleton: &Skeleton, reading: &Reading<'_>) -> Result<Structure, StructureError> {
    structure(Cursor::of_skeleton(skeleton), reading)
}

fn structure(file: Cursor<'_>, reading: &Reading<'_>) -> Result<Structure, StructureError> {
    let (mut structure, unread) = first_block(file, reading.limits, |block, passed| block.structure(reading, passed))?;
    structure.unread.blocks = unread.counts.blocks;
    structure.warnings.extend(unread.warnings());
    Ok(structure)
}

/// Applies `read` to the data blocks until it returns a value. Returns the atoms of the blocks after that as well.
fn first_block<T>(
    mut file: Cursor<'_>,
    limits: &ReadLimits,
    read: impl Fn(&BinaryBlock<'_>, &mut Passed) -> Result<Option<T>, StructureError>,
) -> Result<(T, UnreadAtoms), StructureError> {
    let (mut passed, mut unread) = (Passed::default(), UnreadAtoms::default());
    let (mut found, mut last, mut any) = (None, None, false);
    let frame = file.map(|key, value| {
        if key != b"dataBlocks" {
            return Ok(());
        }
        any = true;
        value.array(|_, at| {
            if found.is_some() {
                // Data after the atoms must be well-formed, but is not used.
                if let Ok(block) = BinaryBlock::read(&mut at.clone(), &mut Passed::default()) {
                    unread.add_block(block.name.as_deref(), block.n_atoms(limits));
                }
                return Ok(());
            }
            passed.block();
            let block = BinaryBlock::read(at, &mut passed)?;
            found = read(&block, &mut passed).transpose();
            last = block.name;
            Ok(())
        })
    });
    frame.map_err(|fault| fault.within("BinaryCIF"))?;
    match found {
        Some(value) => value.map(|value| (value, unread)),
        None if any => Err(passed.no_atoms("BinaryCIF", last)),
        None => Err(Fault::new("nothing", "`dataBlocks`").within("BinaryCIF").into()),
    }
}

/// A table of a block.
#[derive(Debug)]
struct Category<'a> {
    /// Name without the underscore.
    name: &'a [u8],
    rows: u64,
    columns: Cursor<'a>,
}

impl<'a> Category<'a> {
    fn read(at: &mut Cursor<'a>) -> Result<Self, Box<Fault>> {
        let (mut name, mut rows, mut columns) = (None, None, None);
        at.map(|key, value| {
            match key {
                b"name" => name = Some(value.text()?),
                b"rowCount" => rows = Some(*value),
                b"columns" => columns = Some(*value),
                _ => {}
            }
            Ok(())
        })?;
        let name = name.ok_or_else(|| Fault::new("a category without a name", "`name`"))?;
        let name = name.strip_prefix(b"_").unwrap_or(name);
        let missing = |what: &str| Fault::new("nothing", what).within(decode(name));
        let mut rows = rows.ok_or_else(|| missing("`rowCount`"))?;
        let rows = rows.whole("a number of rows").map_err(|f| f.within("rowCount").within(decode(name)))?;
        Ok(Self { name, rows, columns: columns.ok_or_else(|| missing("`columns`"))? })
    }

    fn location(&self) -> String {
        format!("BinaryCIF, {}", decode(self.name))
    }

    fn columns(&self) -> Result<Vec<Raw<'a>>, Box<Fault>> {
        let mut columns = Vec::new();
        let mut at = self.columns;
        at.array(|_, column| {
            if columns.len() >= MAX_COLUMNS {
                return Err(Fault::new("more columns", format!("at most {MAX_COLUMNS}")));
            }
            columns.push(Raw::read(column)?);
            Ok(())
        })?;
        Ok(columns)
    }

    /// Decodes an item; integers become texts if `texts` is true. Returns `None` if the category lacks the item.
    fn column(&self, item: &str, max_rows: usize, texts: bool) -> Result<Option<DecodedColumn<'a>>, Box<Fault>> {
        let columns = self.columns()?;
        let named = columns.iter().find(|c| c.name.eq_ignore_ascii_case(item.as_bytes()));
        let Some(raw) = named else { return Ok(None) };
        let Some(rows) = usize::try_from(self.rows).ok().filter(|&n| n <= max_rows) else {
            return Err(Fault::new(format!("{} rows", self.rows), format!("at most {max_rows}")).within("rowCount"));
        };
        raw.load(DecodeLimits { rows, texts: max_rows }, texts).map(Some)
    }

    /// Returns the first value of an item, normalized, of at most `max` characters.
    fn value(&self, item: &str, max: usize, limits: &ReadLimits) -> Result<Option<String>, Box<Fault>> {
        let column = self.column(item, limits.max_rows(), true)?.filter(|_| self.rows > 0);
        Ok(column.as_ref().and_then(|column| column.text(0)).and_then(|text| normalize(text, max)))
    }

    /// Returns the limits of decoding, or `None` if there are more rows than allowed atoms.
    fn bounds(&self, limits: &ReadLimits) -> Option<DecodeLimits> {
        let rows = usize::try_from(self.rows).ok().filter(|&n| n <= limits.max_rows())?;
        // Unused texts are allowed, within a limit.
        Some(DecodeLimits { rows, texts: rows.max(MAX_UNUSED_TEXTS).min(limits.max_rows()) })
    }
}

/// Names of the required categories that [`Categories`] does not include.
const CATEGORIES: [&[u8]; 4] = [b"atom_site", b"entry", b"struct", SPHERES.as_bytes()];

/// A data block with its required categories.
#[derive(Debug, Default)]
struct BinaryBlock<'a> {
    name: Option<String>,
    categories: Vec<Category<'a>>,
}

impl<'a> BinaryBlock<'a> {
    fn read(at: &mut Cursor<'a>, passed: &mut Passed) -> Result<Self, Box<Fault>> {
        let mut block = Self::default();
        let mut any = false;
        at.map(|key, value| {
            match key {
                b"header" => block.name = normalize(value.text().map_err(|f| f.within("header"))?, 80),
                b"categories" => {
                    any = true;
                    value.array(|_, at| {
                        block.keep(Category::read(at)?, passed);
                        Ok(())
                    })?;
                }
                _ => {}
            }
            Ok(())
        })?;
        if any { Ok(block) } else { Err(Fault::new("nothing", "`categories`")) }
    }

    /// Stores a category if it is required.
    fn keep(&mut self, category: Category<'a>, passed: &mut Passed) {
        if !passed.is_full() {
            passed.category(decode(category.name));
        }
        let known = |c: &Category<'_>| c.name.eq_ignore_ascii_case(category.name);
        let required = Categories::include(category.name)
            || CATEGORIES.iter().any(|name| category.name.eq_ignore_ascii_case(name));
        if required && !self.categories.iter().any(known) {
            self.categories.push(category);
        }
    }

    /// Returns a category by its name in lower case.
    fn category(&self, name: &str) -> Option<&Category<'a>> {
        self.categories.iter().find(|category| category.name.eq_ignore_ascii_case(name.as_bytes()))
    }

    /// Returns the structure, if the block has atoms with coordinates.
    fn structure(&self, reading: &Reading<'_>, passed: &mut Passed) -> Result<Option<Structure>, StructureError> {
        let Some(site) = self.site(reading, passed)? else { return Ok(None) };
        let (SiteColumns { raw, layout, bounds, location }, mut source) = self.source(site, reading)?;
        reading.text.grow(rows::window_bytes(&layout, bounds.rows))?;
        let memory = reading.reserve(Columns::bytes(bounds.rows))?;
        let atoms = rows::read(&raw, layout, bounds, reading)?;
        let (columns, tables, warnings) = atoms.map_err(|fault| fault.within(&location))?;
        memory.keep();
        source.warnings.splice(..0, warnings.messages(|fault| fault.within(&location).into()));
        columns.finish(tables, source, reading).map(Some)
    }

    /// Returns the number of atoms with coordinates. Columns that cannot be read count as missing, as do more rows than
    /// the limit.
    fn n_atoms(&self, limits: &ReadLimits) -> u64 {
        let Some(category) = self.category("atom_site").filter(|c| c.bounds(limits).is_some()) else { return 0 };
        let layout = category.columns().and_then(|raw| layout(&raw));
        if layout.is_ok_and(|layout| layout.missing().is_none()) { category.rows } else { 0 }
    }

    /// Returns the columns of the atoms, if the block has some with coordinates.
    fn site(&self, reading: &Reading<'_>, passed: &mut Passed) -> Result<Option<SiteColumns<'a>>, StructureError> {
        let limits = reading.limits;
        let Some(category) = self.category("atom_site").filter(|category| category.rows > 0) else { return Ok(None) };
        let bounds = category.bounds(limits).ok_or_else(|| limits.too_many_atoms().error::<StructureError>())?;
        let location = category.location();
        let raw = category.columns().map_err(|fault| fault.within(&location))?;
        let layout = layout(&raw).map_err(|fault| fault.within(&location))?;
        if let Some(missing) = layout.missing() {
            passed.lacking(missing);
            return Ok(None);
        }
        Ok(Some(SiteColumns { raw, layout, bounds, location }))
    }

    /// Returns the columns to decode, and the fields of the structure besides its atoms.
    fn source(
        &self,
        mut site: SiteColumns<'a>,
        reading: &Reading<'_>,
    ) -> Result<(SiteColumns<'a>, SourceFields), StructureError> {
        let (categories, warnings) = self.categories(reading)?;
        if categories.entities_are_known() {
            // The columns are not needed.
            site.layout = site.layout.with_known_entities();
        }
        // Decoded data counts as decompressed data, because a few bytes of run-length encoding may expand to many.
        let limit = reading.limits.max_inflated_bytes;
        if rows::decoded_bytes(&site.layout, site.bounds.rows) > limit {
            return Err(Exceeded::new(Limit::InflatedBytes, limit).error());
        }
        let value = |category, item, max| -> Result<Option<String>, StructureError> {
            let Some(category) = self.category(category) else { return Ok(None) };
            Ok(category.value(item, max, reading.limits).map_err(|f| f.within(category.location()))?)
        };
        let entry = value("entry", "id", 80)?;
        reading.hold_texts(categories.copy_bytes())?;
        let (annotations, rejected) = categories.annotations();
        let mut unread = UnreadAtoms::default();
        let spheres = self.category(SPHERES).filter(|category| category.bounds(reading.limits).is_some());
        unread.counts.spheres = spheres.map_or(0, |category| category.rows);
        let source = SourceFields {
            id: entry.or_else(|| self.name.clone()),
            title: value("struct", "title", MAX_TITLE)?,
            sequence: Sequence::of(&categories),
            annotations,
            assemblies: categories.assemblies(),
            unread: unread.counts,
            warnings: warnings.into_iter().chain(rejected).chain(unread.warnings()).collect(),
            ..SourceFields::new(SourceFormat::BinaryCif)
        };
        Ok((site, source))
    }

    /// Returns entities and assemblies, and a warning for those that cannot be read.
    fn categories(&self, reading: &Reading<'_>) -> Result<(Categories, Vec<String>), StructureError> {
        let (mut known, mut unread) = (Categories::default(), Vec::new());
        let mut items = (0..categories::ITEMS.len()).peekable();
        while let Some(item_ix) = items.next() {
            let (name, item) = categories::ITEMS[item_ix];
            let Some(category) = self.category(name) else { continue };
            match category.column(item, categories::MAX_VALUES, false) {
                Ok(None) => {}
                Ok(Some(column)) => {
                    for row in 0..usize::try_from(category.rows).unwrap_or(0) {
                        known.add(item_ix, &column.shown(row), reading)?;
                    }
                }
                Err(fault) => {
                    let error = StructureError::from(fault.within(category.location()));
                    if matches!(error, StructureError::Scratch { .. }) {
                        return Err(error);
                    }
                    let what = known.forget(item_ix);
                    unread.push(format!("{error}; {what} are unknown"));
                    // The other items of the same group are useless without this one.
                    while items.next_if(|&next| categories::describe_the_same(next, item_ix)).is_some() {}
                }
            }
        }
        Ok((known, unread))
    }
}

/// Undecoded columns of the atoms of a block.
struct SiteColumns<'a> {
    raw: Vec<Raw<'a>>,
    layout: Layout,
    bounds: DecodeLimits,
    location: String,
}

/// Finds the items among the columns.
fn layout(raw: &[Raw<'_>]) -> Result<Layout, Box<Fault>> {
    Layout::of(raw.iter().map(|column| column.name)).map_err(|twice| {
        Fault::new(format!("two columns {}", decode(raw[twice].name)), "every column once in its category")
    })
}
