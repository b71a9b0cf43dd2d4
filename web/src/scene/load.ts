/** A GLB as something to draw: positions stay as they came, also as integers, and the node says what they mean. */

import { Box3, Matrix4, Sphere, Vector3, type BufferAttribute, type BufferGeometry, type Group, type Mesh } from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

export interface Loaded {
  geometry: BufferGeometry;
  /** From the file's numbers to its units. */
  matrix: Matrix4;
  sphere: Sphere;
  /** What the file says about itself: parameters and report, without what differs from run to run. */
  extras: Record<string, unknown>;
}

const loader = new GLTFLoader();

/** Reads a GLB. Fails where it is none, or holds no triangles. */
export async function load(bytes: ArrayBuffer): Promise<Loaded> {
  if (bytes.byteLength < 20 || new DataView(bytes).getUint32(0, true) !== 0x46546c67) throw new Error("the file is no GLB");
  if (usesMeshopt(bytes)) {
    // Only such files need WebAssembly: on pages that forbid it, all others are shown nevertheless.
    const { MeshoptDecoder } = await import("three/examples/jsm/libs/meshopt_decoder.module.js");
    loader.setMeshoptDecoder(MeshoptDecoder);
  }
  const gltf = await loader.parseAsync(bytes, "");
  const mesh = firstMesh(gltf.scene);
  if (!mesh) throw new Error("the file holds no surface");
  gltf.scene.updateMatrixWorld(true);
  const matrix = mesh.matrixWorld.clone();
  const { geometry } = mesh;
  // From the bounds that the file tells: no look at a million vertices. Integers are bounded as they lie.
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
