// Finishes the build: adds the licences of bundled packages, copies the component into the package @molmesh/client, and
// compresses every file with gzip for embedding.
import { cpSync, readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";

const here = new URL("./", import.meta.url);
const dist = new URL(`${process.argv[2] ?? "dist"}/`, here);
const bundled = [
  ["three.js", "three.txt", "node_modules/three/LICENSE"],
  ["3d-tiles-renderer", "3d-tiles-renderer.txt", "node_modules/3d-tiles-renderer/LICENSE"],
  ["the decoder of meshoptimizer", "meshoptimizer.txt", "node_modules/meshoptimizer/LICENSE.md"],
];
const texts = bundled.map(([name, kept, theirs]) => {
  const text = readFileSync(new URL(`licences/${kept}`, here), "utf8");
  // The binary's licence notices come from these copies, since they are made without Node.
  if (text !== readFileSync(new URL(theirs, here), "utf8")) throw new Error(`licences/${kept} differs from ${theirs}: copy it`);
  return `${name}\n${"-".repeat(100)}\n${text.trim()}\n`;
});
writeFileSync(new URL("assets/licences.txt", dist), `The viewer contains third-party software:\n\n${texts.join("\n\n")}`);

// The component imports all scripts except those of the page.
const client = new URL("client/dist/", here);
cpSync(dist, new URL("viewer/", client), {
  recursive: true,
  filter: (path) => !/\.[^/]*$/.test(path) || /molmesh-viewer\.js$|\/assets\/(?!index-)[^/]*\.js$|licences\.txt$/.test(path),
});
for (const name of ["LICENSE-APACHE", "LICENSE-MIT"]) cpSync(new URL(`../${name}`, here), new URL(name, client));

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
