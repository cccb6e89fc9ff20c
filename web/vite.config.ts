import { defineConfig } from "vitest/config";

const backEnd = "http://127.0.0.1:8080";

export default defineConfig({
  build: {
    target: "es2022",
    // The 3D part is one library of that size; it is loaded only where a robot is looked at.
    chunkSizeWarningLimit: 900,
    // No data: addresses for small assets: what is served is what is in the folder.
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
