import { describe, expect, it } from "vitest";
import { entryText, type Names } from "../../../src/features/account/audit-entry-text";
import { ALL_ENTRIES, AuditReader, accountNamesOf, subjectOf } from "../../../src/features/account/model/audit-log";
import type { AuditRecord } from "../../../src/shared/api/sharing";
import { server } from "../../support/console";
import { list, ok, problem } from "../../support/fake-server";

const AUDIT = "GET /accounts/me/audit";

function record(part: Partial<AuditRecord>): AuditRecord {
  return {
    seq: 1, at: "2026-01-31T12:00:00.000Z", event: "signed-in", target: "", outcome: "done", actor: "Ann",
    account: "account0001", session: "s1", key: "", data: {}, hash: "00", ...part,
  };
}

describe("the audit log", () => {
  it("is read page by page, skips empty pages, and keeps its records when a page fails", async () => {
    const pages = new Map([
      [null, { items: [], cursor: "90" }],
      ["90", { items: [record({ seq: 90 })], cursor: "89" }],
      ["89", { items: [record({ seq: 12 })], cursor: null }],
    ]);
    const serve = (): void => server.on(AUDIT, ({ query }) => ok(pages.get(query.get("cursor"))));
    serve();
    const reader = new AuditReader(server.api);
    await reader.load({ ...ALL_ENTRIES, event: "signed-in" });
    expect(server.calls[0]?.query.get("event")).toBe("signed-in");
    expect(reader.records.value.map(({ seq }) => seq)).toEqual([90]);
    expect(reader.more.value).toBe(true);
    server.on(AUDIT, problem(503, "busy", "Try again in a moment."));
    await reader.loadOlder();
    expect(reader.error.value).toBe("Try again in a moment.");
    expect(reader.records.value).toHaveLength(1);
    serve();
    await reader.loadOlder();
    expect(reader.records.value.map(({ seq }) => seq)).toEqual([90, 12]);
    expect(reader.more.value).toBe(false);
  });

  it("ignores the response to a previous filter", async () => {
    server.on(AUDIT, list(record({ seq: 1 })));
    const reader = new AuditReader(server.api);
    await Promise.all([reader.load(ALL_ENTRIES), reader.load({ ...ALL_ENTRIES, event: "shared" })]);
    expect(reader.records.value).toHaveLength(1);
    expect(reader.busy.value).toBe(false);
  });

  it("offers the accounts that acted or received access as filters, but no API keys", () => {
    const accounts = accountNamesOf([
      record({ account: "a1", actor: "Ann" }),
      record({ account: "a1", actor: "Ann (dashboard)", key: "k1" }),
      record({ account: "", actor: "", data: { with: "b2", name: "Bob" } }),
    ]);
    expect([...accounts]).toEqual([["a1", "Ann"], ["b2", "Bob"]]);
    expect(subjectOf("device:abc-arm")).toEqual(["device", "abc-arm"]);
    expect(subjectOf("abc-arm")).toEqual(["", "abc-arm"]);
  });

  const arm = { target: "device:abc-arm" };
  const forever = { role: "operator", expires_ms: 2 ** 53 };
  it.each<[string, Partial<AuditRecord>, string]>([
    ["signed-in", { data: { how: "link" } }, "Ann signed in with a link."],
    ["shared", { ...arm, data: { with: "b2", ...forever } }, "Ann shared Arm with Bob as operator, until revoked."],
    ["shared", { target: "space:lab", data: { with: "c3", name: "Cid", role: "viewer", expires_ms: 1e12 } }, "Ann shared Laboratory with Cid as viewer, until "],
    ["unshared", { ...arm, data: { with: "b2" } }, "Ann removed Bob’s access to Arm."],
    ["unshared", { ...arm, account: "b2", actor: "Bob", data: { with: "b2" } }, "Bob gave up access to Arm."],
    ["unshared", { target: "device:gone", actor: "", account: "", data: { with: "b2" } }, "Bob’s access to gone expired"],
    ["api-key-made", { target: "key:k1", data: { name: "dashboard", role: "viewer", only: ["space:lab"] } }, "Ann created the API key “dashboard”: viewer, only Laboratory."],
    ["api-key-revoked", { target: "key:k1" }, "Ann revoked the API key “dashboard”."],
    ["stop-ordered", { data: { message: "Ann ordered a stop: test" } }, "Ann ordered a stop: test"],
    ["something-new", { target: "abc-arm" }, "Ann: something-new, Arm."],
  ])("describes %s %o", (event, part, text) => {
    const names: Names = {
      accounts: new Map([["b2", "Bob"]]),
      targets: new Map([["abc-arm", "Arm"], ["lab", "Laboratory"]]),
      keys: new Map([["k1", "dashboard"]]),
    };
    expect(entryText(record({ event, ...part }), names).startsWith(text)).toBe(true);
  });
});
