// The page and the web component: two entries that share one chunk with three.js.
import { defineConfig } from "vite";

/** A running server for `npm run dev`: everything that is not the page is asked of it. */
const server = process.env.MOLMESH ?? "http://127.0.0.1:8080";
const asked = ["/v1", "/openapi.json", "/openapi.yaml", "/sample.pdb", "/docs", "/version", "/problems"];

export default defineConfig({
  build: {
    target: "es2022",
    // Nothing inlined: the content security policy allows no data and no inline script.
    assetsInlineLimit: 0,
    // Without preload helpers, chunks find each other by relative addresses: the component works on pages of other origins.
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
