import { Linter } from "eslint";
import { describe, expect, it } from "vitest";
import imports from "../../scripts/import-rules.mjs";

/** Messages about one import of a file in src. */
function messages(file: string, path: string): string[] {
  const config = { files: ["**/*.ts"], plugins: { imports }, rules: { "imports/layers": "error" as const } };
  const found = new Linter({ cwd: process.cwd() }).verify(`import "${path}";`, [config], `${process.cwd()}/src/${file}`);
  return found.map(({ message }) => message);
}

describe("the import rules", () => {
  it.each([
    ["app/pages/robot-page.ts", "../../features/control"],
    ["features/control/control-bar.ts", "../devices"],
    ["features/sensors/history-card.ts", "../health/model"],
    ["features/control/model/lease.ts", "../../latency/model"],
    ["features/devices/rename.ts", "./texts"],
  ])("accept %s importing %s", (file, path) => {
    expect(messages(file, path)).toEqual([]);
  });

  it.each([
    ["shared/ui/card.ts", "../../features/devices", /shared imports neither/],
    ["features/devices/rename.ts", "../../app/texts", /does not import the app/],
    ["features/devices/rename.ts", "../control", /devices must not import control/],
    ["features/devices/model/device-store.ts", "../../control/model", /devices must not import control/],
    ["features/devices/rename.ts", "../unlisted", /devices must not import unlisted/],
    ["features/control/control-bar.ts", "../devices/rename", /through its index.ts/],
    ["features/control/model/lease.ts", "../../devices", /model\/index.ts/],
  ])("reject %s importing %s", (file, path, message) => {
    expect(messages(file, path)).toEqual([expect.stringMatching(message)]);
  });
});
