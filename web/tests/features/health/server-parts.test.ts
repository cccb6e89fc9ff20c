import { expect, test } from "vitest";
import { worstFirst } from "../../../src/features/health/model/server-parts";
import type { PartStatus, ServerPart } from "../../../src/shared/api/health";

const part = (name: string, status: PartStatus): ServerPart => ({ name, status, message: "", since: "2026-01-01T00:00:00Z" });

test("the worst parts come first, and others keep their order", () => {
  const parts = [part("tables", "ok"), part("blobs", "degraded"), part("broker", "failed"), part("disk", "degraded")];
  expect(worstFirst(parts).map(({ name }) => name)).toEqual(["broker", "blobs", "disk", "tables"]);
  expect(parts.map(({ name }) => name)).toEqual(["tables", "blobs", "broker", "disk"]);
});
