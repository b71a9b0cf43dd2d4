// Walks tilesets with the traversal of 3d-tiles-tools as an independent check of their documents and subtrees.
//
// Reads paths of `tileset.json` from the arguments, or one per line from standard input. Prints one line of JSON for
// each: the tiles below the root, each with its level, its content and the box around it in the axes of the tileset.
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { dirname } from 'node:path';
import { createInterface } from 'node:readline';
import { fileURLToPath } from 'node:url';

// The package is installed in the git-ignored target folder.
const tools = fileURLToPath(new URL('../../target/test-tools/node/', import.meta.url));
const { ResourceResolvers, TilesetTraverser } = createRequire(tools)('3d-tiles-tools');

async function walk(file) {
  const folder = dirname(file);
  const tiles = [];
  const options = { depthFirst: false, traverseExternalTilesets: true };
  const traverser = new TilesetTraverser(folder, ResourceResolvers.createFileResourceResolver(folder), options);
  await traverser.traverse(JSON.parse(readFileSync(file)), async (tile) => {
    const [content] = tile.getFinalContents();
    // The root of a tileset describes all others. Tiles of an assembly refer to the tilesets of its units.
    if (tile.level > 0 && !/\.json$|\{/.test(content?.uri)) {
      tiles.push({ level: tile.level - 1, content: content?.uri, box: tile.asFinalTile().boundingVolume.box });
    }
    return true;
  });
  return { tiles };
}

const files = process.argv.length > 2 ? process.argv.slice(2) : createInterface({ input: process.stdin });
for await (const file of files) {
  if (!file) continue;
  const answer = await walk(file).catch((error) => ({ error: String(error), tiles: [] }));
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
