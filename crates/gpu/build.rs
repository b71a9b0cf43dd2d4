//! Build script: assembles and validates the shaders, and generates their table.
//!
//! Fragments replace the `#include` lines of each `shaders/<stage>.wgsl`. The result is validated with the capabilities
//! that the device code requests (none beyond WebGPU's). The table lists the bindings by name and the layouts of all
//! structs in buffers. All broken shaders are reported at once.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::{env, fs};

use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{AddressSpace, Module, StorageAccess, TypeInner};

/// Folder of the shaders.
const FOLDER: &str = "../../shaders";

/// Generated tables: names of the table and its layouts, folder of the shaders, and shaders in execution order.
const TABLES: [(&str, &str, &str, &[&str]); 3] = [
    ("SHADERS", "LAYOUTS", "", &["bin", "field", "classify", "scan", "refine", "interpolate", "emit", "measure"]),
    ("SPHERE_SHADERS", "SPHERE_LAYOUTS", "spheres/", &["field", "refine", "interpolate"]),
    ("PICTURE", "PICTURE_LAYOUTS", "picture/", &["vertex", "fragment", "resolve", "finish"]),
];

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed={FOLDER}");
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    let (mut generated, mut broken, mut n) = (String::new(), Vec::new(), 0);
    // FNV-1a.
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for (table, layouts_table, folder, names) in TABLES {
        n += names.len();
        let mut layouts = BTreeSet::new();
        // The meshing stages address their buffers by enum.
        let by_enum = table != "PICTURE";
        let buffer = if by_enum { "BufferId" } else { "&str" };
        writeln!(generated, "pub(super) static {table}: [Shader<{buffer}>; {}] = [", names.len())
            .expect("writing to a string cannot fail");
        for name in names {
            match assemble(Path::new(FOLDER), &format!("{folder}{name}.wgsl"), &mut BTreeSet::new())
                .and_then(|source| checked(&source).map(|module| (source, module)))
            {
                Ok((source, module)) => {
                    let file = format!("{}{name}.wgsl", folder.replace('/', "_"));
                    fs::write(out.join(&file), &source).expect("OUT_DIR can be written");
                    let add = |hash: u64, byte| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
                    hash = source.bytes().fold(hash, add);
                    let bindings = bindings(&module, by_enum);
                    writeln!(
                        generated,
                        "Shader {{ stage: {name:?}, source: include_str!({file:?}), bindings: &[{bindings}] }},"
                    )
                    .expect("writing to a string cannot fail");
                    layouts.extend(structs(&module));
                }
                Err(why) => broken.push(format!("shaders/{folder}{name}.wgsl: {why}")),
            }
        }
        generated.push_str("];\n\n");
        if !layouts.is_empty() {
            generated.push_str("/// Name, size, and (field, offset, size) of every struct in a buffer.\n");
            writeln!(generated, "#[cfg(test)]\npub(super) static {layouts_table}: &[StructLayout] = &[")
                .expect("writing to a string cannot fail");
            generated.extend(layouts);
            generated.push_str("];\n\n");
        }
    }
    assert!(broken.is_empty(), "{} of {n} shaders are broken:\n{}", broken.len(), broken.join("\n"));
    writeln!(generated, "/// Hash of all sources.\npub(super) const SHADERS_HASH: &str = \"{hash:016x}\";")
        .expect("writing to a string cannot fail");
    fs::write(out.join("shaders.rs"), generated).expect("OUT_DIR can be written");
}

/// Returns the text of `name` with each `#include` line replaced by its fragment. Includes each fragment once.
fn assemble(folder: &Path, name: &str, seen: &mut BTreeSet<String>) -> Result<String, String> {
    let text = fs::read_to_string(folder.join(name)).map_err(|e| format!("{name}: {e}"))?;
    let mut assembled = String::with_capacity(text.len());
    for line in text.lines() {
        match line.strip_prefix("#include ") {
            Some(fragment) if seen.insert(fragment.to_owned()) => {
                assembled.push_str(&assemble(folder, fragment, seen)?);
            }
            Some(_) => {}
            None => {
                assembled.push_str(line);
                assembled.push('\n');
            }
        }
    }
    Ok(assembled)
}

fn checked(source: &str) -> Result<Module, String> {
    let module = naga::front::wgsl::parse_str(source).map_err(|e| e.emit_to_string(source))?;
    Validator::new(ValidationFlags::all(), Capabilities::empty())
        .validate(&module)
        .map_err(|e| e.emit_to_string(source))?;
    match &module.entry_points[..] {
        [entry] if entry.name == "main" => Ok(module),
        others => Err(format!("{} entry points; expected one named `main`", others.len())),
    }
}

/// Formats the bindings, sorted by number. The buffer is the name of the variable, or with `by_enum` a `BufferId`.
fn bindings(module: &Module, by_enum: bool) -> String {
    let mut rows: Vec<(u32, String)> = module
        .global_variables
        .iter()
        .filter_map(|(_, global)| {
            let at = global.binding.as_ref()?;
            let access = match global.space {
                AddressSpace::Uniform => "Uniform",
                AddressSpace::Storage { access } if access.contains(StorageAccess::STORE) => "Write",
                _ => "Read",
            };
            let name = global.name.as_deref().unwrap_or_default();
            let buffer = if by_enum { format!("BufferId::{}", camel_case(name)) } else { format!("{name:?}") };
            Some((
                at.binding,
                format!("Binding {{ buffer: {buffer}, number: {}, access: Access::{access} }}", at.binding),
            ))
        })
        .collect();
    rows.sort();
    rows.into_iter().map(|(_, row)| row).collect::<Vec<_>>().join(", ")
}

/// Converts `first_atoms` to `FirstAtoms`.
fn camel_case(name: &str) -> String {
    let capitalized = |word: &str| word[..1].to_uppercase() + &word[1..];
    name.split('_').map(capitalized).collect()
}

/// Returns the layouts of all structs in buffers.
fn structs(module: &Module) -> Vec<String> {
    let mut found = Vec::new();
    for (_, global) in module.global_variables.iter().filter(|(_, global)| global.binding.is_some()) {
        let mut ty = &module.types[global.ty];
        if let TypeInner::Array { base, .. } = ty.inner {
            ty = &module.types[base];
        }
        let TypeInner::Struct { members, span } = &ty.inner else { continue };
        let name = ty.name.as_deref().unwrap_or_default();
        let fields: Vec<String> = members
            .iter()
            .map(|member| {
                let size = module.types[member.ty].inner.size(module.to_ctx());
                format!("({:?}, {}, {size})", member.name.as_deref().unwrap_or_default(), member.offset)
            })
            .collect();
        found.push(format!("StructLayout {{ name: {name:?}, size: {span}, fields: &[{}] }},\n", fields.join(", ")));
    }
    found
}
