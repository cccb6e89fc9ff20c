import { defineConfig } from "vitest/config";

const backEnd = "http://127.0.0.1:8080";

export default defineConfig({
  build: {
    target: "es2022",
    // The 3D library has this size; it is loaded only with a 3D view.
    chunkSizeWarningLimit: 900,
    // Small assets are files too, not data: URLs.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
  },
  server: {
    host: "127.0.0.1",
    proxy: { "/api": backEnd },
  },
  test: {
    include: ["tests/**/*.test.ts"],
    environment: "node",
    testTimeout: 20_000,
    maxWorkers: 2,
  },
});
