// After the build: the licences of what is bundled beside it, and every file packed, as the server embeds and sends it.
import { readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";

const here = new URL("./", import.meta.url);
const dist = new URL(`${process.argv[2] ?? "dist"}/`, here);
const bundled = [
  ["three.js", "three.txt", "node_modules/three/LICENSE"],
  ["the decoder of meshoptimizer", "meshoptimizer.txt", "node_modules/meshoptimizer/LICENSE.md"],
];
const texts = bundled.map(([name, kept, theirs]) => {
  const text = readFileSync(new URL(`licences/${kept}`, here), "utf8");
  // The notices of the binary are made without Node, from the texts that are kept.
  if (text !== readFileSync(new URL(theirs, here), "utf8")) throw new Error(`licences/${kept} is not ${theirs} any more: copy it`);
  return `${name}\n${"-".repeat(100)}\n${text.trim()}\n`;
});
writeFileSync(new URL("assets/licences.txt", dist), `The viewer holds the work of others:\n\n${texts.join("\n\n")}`);

let [plain, packed] = [0, 0];
for (const entry of readdirSync(dist, { recursive: true, withFileTypes: true })) {
  if (!entry.isFile() || entry.name.endsWith(".gz")) continue;
  const file = `${entry.parentPath}/${entry.name}`;
  const bytes = readFileSync(file);
  const small = gzipSync(bytes, { level: 9 });
  [plain, packed] = [plain + bytes.length, packed + small.length];
  writeFileSync(`${file}.gz`, small);
  rmSync(file);
}
console.log(`packed ${plain} bytes into ${packed}`);
