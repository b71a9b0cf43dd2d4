/** Loads a GLB for drawing. Positions stay unchanged, also integers; the node transforms them. */

import { Box3, Matrix4, Sphere, Vector3, type BufferAttribute, type BufferGeometry, type Group, type Mesh } from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

export interface Loaded {
  geometry: BufferGeometry;
  /** Transform from stored positions to file units. */
  matrix: Matrix4;
  sphere: Sphere;
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
  const mesh = firstMesh(gltf.scene);
  if (!mesh) throw new Error("the file holds no surface");
  gltf.scene.updateMatrixWorld(true);
  const matrix = mesh.matrixWorld.clone();
  const { geometry } = mesh;
  // Uses the bounds in the file instead of reading all vertices. Bounds of integers are in stored units.
  const box = geometry.boundingBox ?? new Box3().setFromBufferAttribute(geometry.getAttribute("position") as BufferAttribute);
  const sphere = box.clone().applyMatrix4(matrix).getBoundingSphere(new Sphere(new Vector3(), 1));
  const extras = ((gltf.asset as { extras?: Record<string, unknown> }).extras ?? {}) as Record<string, unknown>;
  return { geometry, matrix, sphere, extras };
}

function firstMesh(group: Group): Mesh | null {
  let found: Mesh | null = null;
  group.traverse((object) => {
    if (!found && (object as Mesh).isMesh) found = object as Mesh;
  });
  return found;
}

function usesMeshopt(bytes: ArrayBuffer): boolean {
  const length = new DataView(bytes).getUint32(12, true);
  const json = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 20, length))) as { extensionsUsed?: string[] };
  return (json.extensionsUsed ?? []).some((name) => name.endsWith("_meshopt_compression"));
}
