//! JSON document of a glTF: one scene and one node translated to the mesh's centre. The node has one mesh of one
//! primitive, or a child node with a mesh for each part. A mesh in compressed pieces has a primitive for each piece.

use std::collections::BTreeMap;
use std::ops::Range;

use gltf_json::accessor::{ComponentType, GenericComponentType, Type};
use gltf_json::buffer::{Stride, Target, View};
use gltf_json::material::{AlphaMode, PbrBaseColorFactor, PbrMetallicRoughness, StrengthFactor};
use gltf_json::mesh::{Mode, Primitive, Semantic};
use gltf_json::validation::Checked::Valid;
use gltf_json::validation::USize64;
use gltf_json::{Accessor, Asset, Buffer, Index, Material, Mesh as GltfMesh, Node, Root, Scene};
use serde_json::{Map, Value, json};

use super::layout::{
    ATOM_BYTES, AtomType, BufferLayout, BufferSpan, Drawn, IndexType, ROTATION_BYTES, TRANSLATION_BYTES,
};
use super::pieces::Pieces;
use crate::check::Summary;
use crate::{FormatError, GENERATOR, Meta, Packing, Step, Storage, Units};

/// Blue, in linear light. Like all constants here it is a short binary fraction, which has few digits in JSON.
const BASE_COLOR: [f32; 4] = [0.156_25, 0.390_625, 0.718_75, 1.0];
/// White, which does not change the mesh's own colours.
const WHITE: [f32; 4] = [1.0; 4];
/// Roughness between chalk and plastic: highlights show the shape without hiding it.
const ROUGHNESS: f32 = 0.625;

/// Extension that allows integer vertices. Marked as required: a program without it cannot display the file.
const QUANTIZED: &str = "KHR_mesh_quantization";

/// Extension that repeats a mesh. Marked as required: a program without it would show one instance.
const INSTANCING: &str = "EXT_mesh_gpu_instancing";

/// Content of the buffers that a document describes.
#[derive(Clone, Copy)]
pub(super) enum Content<'a> {
    /// Columns of the whole mesh.
    Columns(&'a BufferLayout),
    /// Compressed pieces of the mesh.
    Pieces(&'a Pieces),
}

impl Content<'_> {
    /// Returns the translations and rotations of instances.
    fn placements(self) -> Option<[BufferSpan; 2]> {
        match self {
            Self::Columns(layout) => layout.placements,
            Self::Pieces(pieces) => pieces.placements,
        }
    }
}

/// Returns the document as a JSON object. With content, it has a first buffer without a URI, which the caller adds if
/// needed.
pub(super) fn document(
    centre: [f64; 3],
    summary: &Summary,
    storage: Storage,
    content: Option<Content<'_>>,
    drawn: &[Drawn<'_>],
    meta: &Meta,
) -> Result<Map<String, Value>, FormatError> {
    let name = meta.name.clone().filter(|name| !name.is_empty());
    let mut root = Root {
        asset: Asset { generator: Some(GENERATOR.to_owned()), ..Asset::default() },
        scene: Some(Index::new(0)),
        ..Root::default()
    };
    let step = content.and_then(|_drawn| storage.packing.step());
    if let Some(step) = step {
        if !step.holds(&summary.bounds) {
            return Err(FormatError::OutOfQuantizationRange { reach: step.reach(), step: step.length() });
        }
        root.extensions_used.push(QUANTIZED.to_owned());
        root.extensions_required.push(QUANTIZED.to_owned());
    }
    let meshes = content.map_or_else(Vec::new, |content| meshes(&mut root, content, drawn, name.as_deref(), summary));
    let placements = content.and_then(Content::placements);
    let placements = placements.map_or_else(Vec::new, |spans| attributes_of_instances(&mut root, spans, drawn));
    let node = root.push(Node { name, translation: Some([0.0; 3]), ..Node::default() });
    root.push(Scene { nodes: vec![node], name: None, extensions: None, extras: None });
    if let [Drawn { name: None, .. }] = drawn {
        root.nodes[0].mesh = meshes.first().copied();
    } else {
        // Each part has a child node of the node that translates the mesh.
        let nodes = meshes.into_iter().zip(drawn).map(|(mesh, part)| {
            root.push(Node { mesh: Some(mesh), name: part.name.map(str::to_owned), ..Node::default() })
        });
        let nodes: Vec<Index<Node>> = nodes.collect();
        root.nodes[0].children = (!nodes.is_empty()).then_some(nodes);
    }

    let json = |error: serde_json::Error| FormatError::Json { reason: error.to_string() };
    let mut value = serde_json::to_value(&root).map_err(json)?;
    // The crate's numbers are single precision, which would move a structure far from the origin by up to 1e-5 Å.
    let units = storage.units;
    value["nodes"][0]["translation"] = Value::from(centre.map(|v| v * units.scale()).to_vec());
    let scale = step.map_or(1.0, |step| f64::from(step.length())) * units.scale();
    if step.is_some() || units != Units::Angstrom {
        value["nodes"][0]["scale"] = Value::from(vec![scale; 3]);
    }
    // The nodes of parts follow that of the mesh.
    for (node, attributes) in (1..).zip(placements) {
        value["nodes"][node]["extensions"] = json!({ INSTANCING: { "attributes": attributes } });
    }
    if let Some(Content::Pieces(pieces)) = content {
        pieces.add_extensions(&mut value);
    }
    value["asset"]["extras"] = Value::Object(extras(centre, units, step, meta));
    match value {
        Value::Object(map) => Ok(map),
        _ => Err(FormatError::Json { reason: "the document is no object".to_owned() }),
    }
}

/// Returns the metadata of the file: units first, then parameters and report.
fn extras(centre: [f64; 3], units: Units, step: Option<Step>, meta: &Meta) -> Map<String, Value> {
    let mut extras = Map::new();
    extras.insert("units".to_owned(), Value::from(units.name()));
    extras.insert("unit_scale".to_owned(), Value::from(units.length()));
    extras.insert("centre".to_owned(), Value::from(centre.to_vec()));
    if let Some(step) = step {
        extras.insert("quantization".to_owned(), json!({ "step": step.length() }));
    }
    for (key, value) in &meta.extras {
        if !extras.contains_key(key) {
            extras.insert(key.clone(), value.clone());
        }
    }
    extras
}

/// Adds buffers, views, accessors, material and a mesh for each element of `drawn`. Returns the meshes.
fn meshes(
    root: &mut Root,
    content: Content<'_>,
    drawn: &[Drawn<'_>],
    name: Option<&str>,
    summary: &Summary,
) -> Vec<Index<GltfMesh>> {
    let primitives: Vec<Vec<Primitive>> = match content {
        Content::Columns(layout) => {
            let buffer = buffer(root, layout.len);
            let material = root.push(material(layout.colors.is_some(), summary));
            let columns = BufferColumns::new(root, buffer, layout, drawn.len() > 1, material);
            drawn.iter().map(|part| vec![columns.primitive(root, layout, part)]).collect()
        }
        Content::Pieces(pieces) => pieces.primitives(root, drawn.len(), summary),
    };
    let mesh = |(part, primitives): (&Drawn<'_>, Vec<Primitive>)| {
        root.push(GltfMesh {
            primitives,
            name: part.name.or(name).map(str::to_owned),
            weights: None,
            extensions: None,
            extras: None,
        })
    };
    drawn.iter().zip(primitives).map(mesh).collect()
}

/// Adds views and accessors of the instances of each element of `drawn`. Returns the attributes of the extension.
fn attributes_of_instances(root: &mut Root, spans: [BufferSpan; 2], drawn: &[Drawn<'_>]) -> Vec<Value> {
    let [translations, rotations] = spans;
    root.extensions_used.push(INSTANCING.to_owned());
    root.extensions_required.push(INSTANCING.to_owned());
    let mut column = |span, row_bytes, shape| {
        let view = view(root, Index::new(0), span, None, None);
        BufferColumn { view, row_bytes, component: ComponentType::F32, shape }
    };
    let translations = column(translations, TRANSLATION_BYTES, Type::Vec3);
    let rotations = column(rotations, ROTATION_BYTES, Type::Vec4);
    let mut attributes = |part: &Drawn<'_>| {
        let (first, count) = (part.placements.start, part.placements.end - part.placements.start);
        let [translation, rotation] =
            [&translations, &rotations].map(|column| root.push(column.accessor(first, count)));
        json!({ "TRANSLATION": translation.value(), "ROTATION": rotation.value() })
    };
    drawn.iter().map(&mut attributes).collect()
}

/// Adds a buffer without a URI.
pub(super) fn buffer(root: &mut Root, bytes: u64) -> Index<Buffer> {
    root.push(Buffer { byte_length: USize64(bytes), name: None, uri: None, extensions: None, extras: None })
}

/// Column of the buffer.
struct BufferColumn {
    view: Index<View>,
    /// Length of a row, bytes.
    row_bytes: u64,
    component: ComponentType,
    shape: Type,
}

impl BufferColumn {
    /// Returns an accessor of `count` values from row `first` on.
    fn accessor(&self, first: u64, count: u64) -> Accessor {
        let normalized =
            matches!((self.component, self.shape), (ComponentType::I8, _) | (ComponentType::U16, Type::Vec4));
        let offset = self.row_bytes * first;
        Accessor {
            buffer_view: Some(self.view),
            byte_offset: (offset > 0).then_some(USize64(offset)),
            count: USize64(count),
            component_type: Valid(GenericComponentType(self.component)),
            type_: Valid(self.shape),
            min: None,
            max: None,
            normalized,
            sparse: None,
            name: None,
            extensions: None,
            extras: None,
        }
    }
}

/// Columns of a buffer, and the material, of one or several primitives.
pub(super) struct BufferColumns {
    attributes: Vec<(Semantic, BufferColumn)>,
    indices: BufferColumn,
    material: Index<Material>,
}

impl BufferColumns {
    /// Adds views of `buffer`: those of the attributes in the order of the layout, then that of the indices. `shared`
    /// views, which accessors of several parts use, must have a stride.
    pub(super) fn new(
        root: &mut Root,
        buffer: Index<Buffer>,
        layout: &BufferLayout,
        shared: bool,
        material: Index<Material>,
    ) -> Self {
        let packing = layout.storage.packing;
        let [position, normal, color] = match packing {
            Packing::Full => [ComponentType::F32; 3],
            Packing::Quantized(_) => [ComponentType::I16, ComponentType::I8, ComponentType::U16],
        };
        let mut attribute = |semantic, span, row_bytes, component, shape| {
            let stride = match component {
                ComponentType::I16 => Some(Stride(8)),
                ComponentType::I8 => Some(Stride(4)),
                ComponentType::U16 if shape == Type::Scalar => Some(Stride(4)),
                _ => shared.then(|| Stride(usize::try_from(row_bytes).unwrap_or(0))),
            };
            let view = view(root, buffer, span, stride, Some(Target::ArrayBuffer));
            (semantic, BufferColumn { view, row_bytes, component, shape })
        };
        let bytes = packing.position_bytes();
        let mut attributes = vec![attribute(Semantic::Positions, layout.positions, bytes, position, Type::Vec3)];
        // Without normals viewers shade each triangle flat, as the standard requires.
        let bytes = packing.normal_bytes();
        attributes.extend(layout.normals.map(|span| attribute(Semantic::Normals, span, bytes, normal, Type::Vec3)));
        let bytes = packing.color_bytes();
        attributes.extend(layout.colors.map(|span| attribute(Semantic::Colors(0), span, bytes, color, Type::Vec4)));
        attributes.extend(layout.atoms.map(|(atom_type, span)| {
            let component = match atom_type {
                AtomType::U16 => ComponentType::U16,
                AtomType::F32 => ComponentType::F32,
            };
            attribute(Semantic::Extras("ATOM".to_owned()), span, ATOM_BYTES, component, Type::Scalar)
        }));
        let (index_type, span) = layout.indices;
        let component = match index_type {
            IndexType::U8 => ComponentType::U8,
            IndexType::U16 => ComponentType::U16,
            IndexType::U32 => ComponentType::U32,
        };
        let view = view(root, buffer, span, None, Some(Target::ElementArrayBuffer));
        let indices = BufferColumn { view, row_bytes: index_type.bytes(), component, shape: Type::Scalar };
        Self { attributes, indices, material }
    }

    /// Adds the accessors of a part. Returns its primitive.
    pub(super) fn primitive(&self, root: &mut Root, layout: &BufferLayout, part: &Drawn<'_>) -> Primitive {
        let count = |rows: &Range<u64>| rows.end - rows.start;
        let mut attributes = BTreeMap::new();
        for (semantic, column) in &self.attributes {
            let mut accessor = column.accessor(part.vertices.start, count(&part.vertices));
            if *semantic == Semantic::Positions {
                // These are exact values of the buffer: rounding preserves the order, and doubles represent floats
                // exactly.
                let [low, high] = part.bounds.map(|row| match layout.storage.packing {
                    Packing::Full => Value::from(row.map(f64::from).to_vec()),
                    Packing::Quantized(step) => Value::from(step.position(row).to_vec()),
                });
                (accessor.min, accessor.max) = (Some(low), Some(high));
            }
            attributes.insert(Valid(semantic.clone()), root.push(accessor));
        }
        let indices = self.indices.accessor(3 * part.triangles.start, 3 * count(&part.triangles));
        Primitive {
            attributes,
            indices: Some(root.push(indices)),
            material: Some(self.material),
            mode: Valid(Mode::Triangles),
            targets: None,
            extensions: None,
            extras: None,
        }
    }
}

fn view(
    root: &mut Root,
    buffer: Index<Buffer>,
    span: BufferSpan,
    stride: Option<Stride>,
    target: Option<Target>,
) -> Index<View> {
    root.push(View {
        buffer,
        byte_length: USize64(span.len),
        byte_offset: (span.offset > 0).then_some(USize64(span.offset)),
        byte_stride: stride,
        target: target.map(Valid),
        name: None,
        extensions: None,
        extras: None,
    })
}

/// Returns the material of a surface.
pub(super) fn material(coloured: bool, summary: &Summary) -> Material {
    Material {
        name: Some("surface".to_owned()),
        alpha_mode: Valid(if summary.translucent { AlphaMode::Blend } else { AlphaMode::Opaque }),
        double_sided: summary.open,
        pbr_metallic_roughness: PbrMetallicRoughness {
            base_color_factor: PbrBaseColorFactor(if coloured { WHITE } else { BASE_COLOR }),
            metallic_factor: StrengthFactor(0.0),
            roughness_factor: StrengthFactor(ROUGHNESS),
            ..PbrMetallicRoughness::default()
        },
        ..Material::default()
    }
}
