import js from "@eslint/js";
import tseslint from "typescript-eslint";
import importRules from "./scripts/import-rules.mjs";

const pageNames = ["document", "window", "navigator", "location", "history", "localStorage", "sessionStorage"];

export default tseslint.config(
  { ignores: ["dist", "node_modules"] },
  js.configs.recommended,
  {
    files: ["**/*.{ts,tsx}"],
    extends: [...tseslint.configs.strictTypeChecked, ...tseslint.configs.stylisticTypeChecked],
    languageOptions: { parserOptions: { projectService: true } },
    rules: {
      "@typescript-eslint/restrict-template-expressions": ["error", { allowNumber: true }],
      "@typescript-eslint/switch-exhaustiveness-check": "error",
      // `onClick={() => signal.value = x}` returns a value that nothing reads.
      "@typescript-eslint/no-confusing-void-expression": ["error", { ignoreArrowShorthand: true }],
      eqeqeq: "error",
      "no-console": "error",
    },
  },
  {
    files: ["src/**"],
    plugins: { imports: importRules },
    rules: { "imports/layers": "error" },
  },
  {
    // Models and the shared client do not use the DOM, so that they run and are tested without a page.
    files: ["src/features/*/model/**", "src/shared/{api,lib,mqtt,xmpp}/**"],
    rules: {
      "no-restricted-globals": ["error", ...pageNames],
      "no-restricted-imports": ["error", { patterns: ["preact", "preact/*", "three", "three/*", "uplot"] }],
    },
  },
  {
    files: ["scripts/**", "*.config.js"],
    languageOptions: { globals: { URL: "readonly", process: "readonly" } },
  },
);
