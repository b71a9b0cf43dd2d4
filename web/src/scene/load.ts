/** Loads a GLB for drawing. Positions stay unchanged, also integers; the node transforms them. */

import {
  Box3, type BufferAttribute, type BufferGeometry, DoubleSide, type Group, type InstancedMesh, type Material, Matrix4, type Mesh,
  Sphere, Vector3,
} from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

/**
 * Part of a surface, one of its instances, or a whole surface that is not divided. A compressed surface consists of
 * pieces, which share the name of their part.
 */
export interface Part {
  name: string;
  geometry: BufferGeometry;
  /** Transform from stored positions to file units. */
  matrix: Matrix4;
}

export interface Loaded {
  /** At least one. All have the same attributes. */
  parts: Part[];
  sphere: Sphere;
  /** True if both sides of the triangles are drawn, as for open surfaces. */
  twoSided: boolean;
  /** Parameters and report in the file, without values that differ between runs. */
  extras: Record<string, unknown>;
}

const loader = new GLTFLoader();

/** Reads a GLB. Throws if it is invalid or has no triangles. */
export async function load(bytes: ArrayBuffer): Promise<Loaded> {
  if (bytes.byteLength < 20 || new DataView(bytes).getUint32(0, true) !== 0x46546c67) throw new Error("the file is no GLB");
  if (usesMeshopt(bytes)) {
    // Only such files need WebAssembly. Pages that forbid it can show all other files.
    const { MeshoptDecoder } = await import("three/examples/jsm/libs/meshopt_decoder.module.js");
    loader.setMeshoptDecoder(MeshoptDecoder);
  }
  const gltf = await loader.parseAsync(bytes, "");
  gltf.scene.updateMatrixWorld(true);
  const { parts, twoSided } = partsOf(gltf.scene);
  if (!parts.length) throw new Error("the file holds no surface");
  const box = new Box3();
  for (const { geometry, matrix } of parts) {
    // Uses the bounds in the file instead of reading all vertices. Bounds of integers are in stored units.
    const own = geometry.boundingBox ?? new Box3().setFromBufferAttribute(geometry.getAttribute("position") as BufferAttribute);
    box.union(own.clone().applyMatrix4(matrix));
  }
  const sphere = box.getBoundingSphere(new Sphere(new Vector3(), 1));
  const extras = ((gltf.asset as { extras?: Record<string, unknown> }).extras ?? {}) as Record<string, unknown>;
  return { parts, sphere, twoSided, extras };
}

/** Returns Å per unit of the file; 1 if it does not state its units. */
export function unitScale({ extras }: Loaded): number {
  const scale = Number(extras["unit_scale"] ?? 1);
  return Number.isFinite(scale) && scale > 0 ? scale : 1;
}

/** Returns all meshes with their names in the file, because three.js changes the names of objects. */
function partsOf(group: Group): Pick<Loaded, "parts" | "twoSided"> {
  const parts: Part[] = [];
  let twoSided = false;
  group.traverse((object) => {
    const mesh = object as Mesh;
    if (!mesh.isMesh) return;
    twoSided ||= (mesh.material as Material).side === DoubleSide;
    // The pieces of a part are children of an object that has its name.
    const name = String(mesh.userData["name"] ?? mesh.parent?.userData["name"] ?? mesh.name);
    for (const matrix of transformsOf(mesh, mesh.matrixWorld)) parts.push({ name, geometry: mesh.geometry, matrix });
  });
  return { parts, twoSided };
}

/** Returns the transforms of a mesh that `own` precedes: one, or one for each of its instances. */
export function transformsOf(mesh: Mesh, own: Matrix4): Matrix4[] {
  const instanced = mesh as InstancedMesh;
  if (!instanced.isInstancedMesh) return [own.clone()];
  return Array.from({ length: instanced.count }, (_, i) => {
    const matrix = new Matrix4();
    instanced.getMatrixAt(i, matrix);
    return matrix.premultiply(own);
  });
}

function usesMeshopt(bytes: ArrayBuffer): boolean {
  const length = new DataView(bytes).getUint32(12, true);
  const json = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 20, length))) as { extensionsUsed?: string[] };
  return (json.extensionsUsed ?? []).some((name) => name.endsWith("_meshopt_compression"));
}
