// Compresses the vertices and indices of a GLB with EXT_meshopt_compression, as some tools do.
import path from "node:path";
import { pathToFileURL } from "node:url";
import { glb, MODULES } from "./lib.mjs";

const { MeshoptEncoder } = await import(pathToFileURL(path.join(MODULES, "meshoptimizer/meshopt_encoder.js")));

/** Returns a compressed copy of a GLB. */
export async function packed(bytes) {
  await MeshoptEncoder.ready;
  const { json, start } = glb(bytes);
  const sizes = { 5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4 };
  const parts = [];
  let at = 0;
  json.bufferViews.forEach((view, i) => {
    const accessor = json.accessors.find((a) => a.bufferView === i);
    const source = new Uint8Array(bytes.buffer, bytes.byteOffset + start + (view.byteOffset ?? 0), view.byteLength).slice();
    const triangles = view.target === 34963;
    const stride = triangles ? sizes[accessor.componentType] : (view.byteStride ?? sizes[accessor.componentType] * (accessor.type === "VEC3" ? 3 : 1));
    const encoded = triangles && stride > 1 ? MeshoptEncoder.encodeGltfBuffer(source, accessor.count, stride, "TRIANGLES") : MeshoptEncoder.encodeGltfBuffer(source, accessor.count, stride, "ATTRIBUTES");
    view.extensions = { EXT_meshopt_compression: { buffer: 0, byteOffset: at, byteLength: encoded.length, byteStride: stride, count: accessor.count, mode: triangles ? "TRIANGLES" : "ATTRIBUTES" } };
    const padded = Buffer.alloc((encoded.length + 3) & ~3);
    padded.set(encoded);
    parts.push(padded);
    at += padded.length;
    // Buffer 1 has no data; loaders without the extension find nothing to read.
    view.buffer = 1;
  });
  const last = json.bufferViews.reduce((end, view) => Math.max(end, (view.byteOffset ?? 0) + view.byteLength), 0);
  json.buffers = [{ byteLength: at }, { byteLength: last, extensions: { EXT_meshopt_compression: { fallback: true } } }];
  for (const list of ["extensionsUsed", "extensionsRequired"]) json[list] = [...(json[list] ?? []), "EXT_meshopt_compression"];
  const text = Buffer.from(JSON.stringify(json));
  const head = Buffer.alloc((text.length + 3) & ~3, 0x20);
  text.copy(head);
  const body = Buffer.concat(parts);
  const words = (...numbers) => Buffer.from(new Uint32Array(numbers).buffer);
  return Buffer.concat([words(0x46546c67, 2, 28 + head.length + body.length, head.length, 0x4e4f534a), head, words(body.length, 0x004e4942), body]);
}
