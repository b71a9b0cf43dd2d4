// Validates .glb and .gltf files with the Khronos validator as an independent check of the product's output.
//
// Reads file names from the arguments, or one per line from standard input. Prints one line of JSON for each: the
// numbers of errors, warnings, infos and hints, the count of each code, and the first messages. A file that the
// validator does not recognize as glTF gives `error`.
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { createInterface } from 'node:readline';
import { fileURLToPath } from 'node:url';

// The package is installed in the git-ignored target folder.
const tools = fileURLToPath(new URL('../../target/test-tools/node/', import.meta.url));
const validator = createRequire(tools)('gltf-validator');

async function report(file) {
  // 0 means unlimited. A limit could hide errors behind warnings.
  const result = await validator.validateBytes(new Uint8Array(readFileSync(file)), { uri: file, maxIssues: 0 });
  const { numErrors, numWarnings, numInfos, numHints, messages } = result.issues;
  const codes = {};
  for (const message of messages) codes[message.code] = (codes[message.code] ?? 0) + 1;
  return {
    file,
    errors: numErrors,
    warnings: numWarnings,
    infos: numInfos,
    hints: numHints,
    codes,
    messages: messages.slice(0, 5).map((m) => `${m.code} ${m.pointer ?? ''}: ${m.message}`),
    vertices: result.info?.totalVertexCount ?? 0,
    triangles: result.info?.totalTriangleCount ?? 0,
  };
}

const files = process.argv.length > 2 ? process.argv.slice(2) : createInterface({ input: process.stdin });
for await (const file of files) {
  if (!file) continue;
  const answer = await report(file).catch((error) => ({ file, error: String(error) }));
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
