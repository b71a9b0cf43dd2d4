// Builds the page and the web component as two entries that share a chunk with three.js.
import { defineConfig } from "vite";

/** Server that `npm run dev` forwards requests of the page to. */
const server = process.env.MOLMESH ?? "http://127.0.0.1:8080";
const asked = ["/v1", "/openapi.json", "/openapi.yaml", "/sample.pdb", "/docs", "/version", "/problems"];

export default defineConfig({
  build: {
    target: "es2022",
    // No inlining: the content security policy forbids data URLs and inline scripts.
    assetsInlineLimit: 0,
    // Without preload helpers, chunks use relative URLs, so the component works on pages of other origins.
    modulePreload: false,
    chunkSizeWarningLimit: 900,
    rolldownOptions: {
      input: { index: "index.html", "molmesh-viewer": "src/element.ts" },
      preserveEntrySignatures: "exports-only",
      output: {
        entryFileNames: ({ name }) => (name === "molmesh-viewer" ? "molmesh-viewer.js" : "assets/[name]-[hash].js"),
        chunkFileNames: "assets/[name]-[hash].js",
        assetFileNames: "assets/[name]-[hash][extname]",
      },
    },
  },
  server: { proxy: Object.fromEntries(asked.map((path) => [path, server])) },
});
