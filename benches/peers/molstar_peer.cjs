// Meshes a structure file with the Gaussian surface of Mol* on the CPU: `molstar_peer.cjs MODULES IN OUT SPACING` writes PLY.
// Its density is Σ exp(−s d²/r²) at exp(−s), which is ours with smoothness s. It is cut off at two radii without smoothing.
// The script calls an inner function, because the outer one coarsens the grids of large structures.
"use strict";
const fs = require("fs");
const [modules, source, target, spacing] = process.argv.slice(2);
const lib = (name) => require(`${modules}/molstar/lib/commonjs/${name}`);
const { CIF } = lib("mol-io/reader/cif.js");
const { parsePDB } = lib("mol-io/reader/pdb/parser.js");
const { trajectoryFromMmCIF } = lib("mol-model-formats/structure/mmcif.js");
const { trajectoryFromPDB } = lib("mol-model-formats/structure/pdb.js");
const { Structure } = lib("mol-model/structure.js");
const { PhysicalSizeTheme } = lib("mol-theme/size/physical.js");
const { ParamDefinition } = lib("mol-util/param-definition.js");
const { getStructureConformationAndRadius, DefaultCommonSurfaceProps } = lib("mol-repr/structure/visual/util/common.js");
const { computeGaussianDensity } = lib("mol-math/geometry/gaussian-density.js");
const { computeMarchingCubesMesh } = lib("mol-geo/util/marching-cubes/algorithm.js");
const { Mesh } = lib("mol-geo/geometry/mesh/mesh.js");

const smoothness = 1.25;

async function structure(path) {
  const text = fs.readFileSync(path, "utf8");
  const pdb = /\.(pdb|ent)$/.test(path);
  const parsed = await (pdb ? parsePDB(text) : CIF.parseText(text)).run();
  if (parsed.isError) throw new Error(parsed.message);
  const trajectory = pdb ? trajectoryFromPDB(parsed.result) : trajectoryFromMmCIF(parsed.result.blocks[0], parsed.result);
  return Structure.ofModel((await trajectory.run()).representative);
}

function write(path, mesh) {
  const vertices = mesh.vertexCount, triangles = mesh.triangleCount;
  const head = ["ply", "format binary_little_endian 1.0", `element vertex ${vertices}`];
  for (const name of ["x", "y", "z", "nx", "ny", "nz"]) head.push(`property float ${name}`);
  head.push(`element face ${triangles}`, "property list uchar int vertex_indices", "end_header\n");
  const position = mesh.vertexBuffer.ref.value, normal = mesh.normalBuffer.ref.value, index = mesh.indexBuffer.ref.value;
  const points = new Float32Array(6 * vertices);
  for (let i = 0; i < vertices; i++) {
    for (let k = 0; k < 3; k++) {
      points[6 * i + k] = position[3 * i + k];
      points[6 * i + 3 + k] = normal[3 * i + k];
    }
  }
  const faces = Buffer.allocUnsafe(13 * triangles);
  for (let i = 0, at = 0; i < triangles; i++) {
    faces[at] = 3;
    for (let k = 0; k < 3; k++) faces.writeUInt32LE(index[3 * i + k], at + 1 + 4 * k);
    at += 13;
  }
  const file = fs.openSync(path, "w");
  for (const part of [Buffer.from(head.join("\n")), Buffer.from(points.buffer), faces]) fs.writeSync(file, part);
  fs.closeSync(file);
}

async function main() {
  const whole = await structure(source);
  const theme = PhysicalSizeTheme({ structure: whole }, ParamDefinition.getDefaultValues(require(
    `${modules}/molstar/lib/commonjs/mol-theme/size/physical.js`).PhysicalSizeThemeParams));
  const { position, boundary, radius } = getStructureConformationAndRadius(whole, theme, DefaultCommonSurfaceProps);
  const properties = { resolution: Number(spacing), radiusOffset: 0, smoothness };
  const density = await computeGaussianDensity(position, boundary.box, radius, properties).run();
  const mesh = await computeMarchingCubesMesh(
    { isoLevel: Math.exp(-smoothness), scalarField: density.field, idField: density.idField }).run();
  Mesh.transform(mesh, density.transform);
  write(target, mesh);
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
