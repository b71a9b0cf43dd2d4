// Decodes compressed GLB files with the decoders of meshoptimizer and of three.js, which must agree.
//
// Reads file names from standard input. Writes the decoded buffer beside each file, with the extension `.decoded`, and
// prints one line of JSON: the file, and the error if there is one.
import { readFileSync, writeFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { createInterface } from 'node:readline';
import { fileURLToPath, pathToFileURL } from 'node:url';

const tools = fileURLToPath(new URL('../../target/test-tools/node/', import.meta.url));
const load = async (name) => (await import(pathToFileURL(createRequire(tools).resolve(name)))).MeshoptDecoder;
const decoders = [await load('meshoptimizer/decoder'), await load('three/examples/jsm/libs/meshopt_decoder.module.js')];
await Promise.all(decoders.map((decoder) => decoder.ready));

function decode(decoder, json, bin) {
  const buffer = new Uint8Array(json.buffers[1].byteLength);
  for (const { byteOffset = 0, byteLength, extensions } of json.bufferViews) {
    const packed = extensions?.EXT_meshopt_compression;
    if (!packed) continue;
    const { byteOffset: start, byteLength: length, count, byteStride, mode, filter } = packed;
    const target = buffer.subarray(byteOffset, byteOffset + byteLength);
    decoder.decodeGltfBuffer(target, count, byteStride, bin.subarray(start, start + length), mode, filter);
  }
  return Buffer.from(buffer);
}

for await (const file of createInterface({ input: process.stdin })) {
  if (!file) continue;
  const answer = { file };
  try {
    const bytes = readFileSync(file);
    const end = 20 + bytes.readUInt32LE(12);
    const json = JSON.parse(bytes.subarray(20, end).toString());
    const [ours, theirs] = decoders.map((decoder) => decode(decoder, json, new Uint8Array(bytes.subarray(end + 8))));
    if (!ours.equals(theirs)) throw new Error('the decoders disagree');
    writeFileSync(`${file}.decoded`, ours);
  } catch (error) {
    answer.error = String(error);
  }
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
