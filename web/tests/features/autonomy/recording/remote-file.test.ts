import { afterEach, describe, expect, it, vi } from "vitest";
import { decodeExcerpt } from "../../../../src/features/autonomy/model/recording/decode-segment";
import { RemoteFile } from "../../../../src/features/autonomy/model/recording/remote-file";
import { ApiError } from "../../../../src/shared/api/http";
import { storedPart } from "../../../../src/shared/api/recordings";
import { rowsFrom, writeSegment } from "../../../support/recordings";

/** A store with one file; returns the requested ranges. */
function store(content: Uint8Array, parts: boolean): string[] {
  const requested: string[] = [];
  vi.stubGlobal("fetch", (_: string, { headers }: { headers: Record<string, string> }) => {
    const range = headers["Range"] ?? "";
    requested.push(range);
    const [from = 0, last = 0] = range.replace("bytes=", "").split("-").map(Number);
    return Promise.resolve(parts ? new Response(content.slice(from, last + 1), { status: 206 }) : new Response(content.slice()));
  });
  return requested;
}

const remote = (length: number): RemoteFile => new RemoteFile(length, (from, to) => storedPart("/files/0.mcap", from, to, new AbortController().signal));

describe("a stored segment", () => {
  afterEach(() => vi.unstubAllGlobals());

  it("shows the rows around a time after three short parts", async () => {
    const content = await writeSegment({ rows: rowsFrom(0, 60) });
    const requested = store(content, true);
    const file = remote(content.length);
    const excerpt = await decodeExcerpt(file, 30);
    expect([excerpt?.extent, file.content]).toEqual(["excerpt", null]);
    const times = excerpt?.time_s ?? new Float64Array();
    expect((times[0] ?? NaN) <= 30 && (times.at(-1) ?? NaN) + 0.01 >= 30).toBe(true);
    const bytes = requested.map((range) => range.replace("bytes=", "").split("-").map(Number)).reduce((sum, [from = 0, last = 0]) => sum + last + 1 - from, 0);
    expect(bytes).toBeLessThan(content.length / 5);
    expect(requested[0]).toBe("bytes=0-4095");
  });

  it("of a store without parts is downloaded as a whole and kept", async () => {
    const content = await writeSegment({ rows: rowsFrom(0, 2) });
    store(content, false);
    const file = remote(content.length);
    expect((await decodeExcerpt(file, 1))?.extent).toBe("excerpt");
    expect(file.content).toEqual(content);
  });

  it("that cannot be downloaded is not called damaged", async () => {
    vi.stubGlobal("fetch", () => Promise.resolve(new Response("", { status: 403 })));
    await expect(decodeExcerpt(remote(100_000), 1)).rejects.toThrow(ApiError);
  });
});
