/** Sharing, invitations and the record of what was done, against the API's shapes. */
import { afterEach, beforeEach, describe, expect, it } from "vitest";
import { Api } from "../../../src/shared/api/client";
import { subjectOf, accountIdsOf, AuditReader, ALL_ENTRIES } from "../../../src/features/account/model/audit-log";
import { Fleet } from "../../../src/features/devices/model/device-list";
import { FollowedInvitation, invitationSecret } from "../../../src/features/sharing/model/invitation-link";
import type { AuditRecord, Share } from "../../../src/shared/api/sharing";
import { Session } from "../../../src/features/account/model/session";
import { secondsLeft, ShareList } from "../../../src/features/sharing/model/shares";
import { entryText, type Names } from "../../../src/features/account/audit-entry-text";
import { seconds } from "../../../src/shared/ui/duration-picker";
import { Cloud, DEVICE, problem, type Call } from "../../support/cloud";
import { until } from "../../support/until";

const SHARES = `/devices/${DEVICE}/shares`;
const INVITATIONS = `/devices/${DEVICE}/invitations`;
const EMPTY = { status: 200, body: { items: [], cursor: null } };

let cloud: Cloud;
let api: Api;

beforeEach(async () => {
  cloud = new Cloud();
  await cloud.start();
  api = new Api(`${cloud.address}/api/v1`);
  await api.me();
});

afterEach(() => cloud.stop());

function bob(part: Partial<Share> = {}): Share {
  return {
    account: { id: "account0002", name: "Bob" },
    role: "operator",
    created_by: "Ann",
    created_at: "2026-01-31T12:00:00.000Z",
    expires_at: null,
    ...part,
  };
}

describe("sharing", () => {
  let shares: Share[];
  let sharing: ShareList;

  beforeEach(async () => {
    shares = [bob()];
    cloud.instead.set(`GET ${SHARES}`, () => ({ status: 200, body: { items: shares, cursor: null } }));
    cloud.instead.set(`GET ${INVITATIONS}`, () => EMPTY);
    cloud.instead.set(`POST ${SHARES}`, ({ body }: Call) => {
      const left = body["expires_in_s"] as number | null;
      const expires = left === null ? null : new Date(Date.now() + left * 1000).toISOString();
      const made = bob({ role: body["role"] as Share["role"], expires_at: expires });
      shares = [made];
      return { status: 201, body: made };
    });
    cloud.instead.set(`DELETE ${SHARES}/account0002`, () => {
      shares = [];
      return { status: 204, body: null };
    });
    sharing = new ShareList(api, { kind: "device", id: DEVICE });
    await sharing.refresh();
  });

  it("says what is still under way while the broker does not answer", async () => {
    shares = [bob()];
    await sharing.refresh();
    const [share] = sharing.shares.value ?? [];
    if (share === undefined) throw new Error("no share");
    const detail = "The share has ended. The broker did not answer.";
    const ended = cloud.instead.get(`DELETE ${SHARES}/account0002`);
    cloud.instead.set(`DELETE ${SHARES}/account0002`, () => ({ status: 202, body: { detail } }));
    await sharing.end(share);
    expect(sharing.rest.value).toBe(detail);
    if (ended !== undefined) cloud.instead.set(`DELETE ${SHARES}/account0002`, ended);
    await sharing.end(share);
    expect(sharing.rest.value).toBe("");
  });

  it("ends at once, and gives back what was ended until when it was", async () => {
    const inAnHour = new Date(Date.now() + 3_600_000).toISOString();
    shares = [bob({ role: "viewer", expires_at: inAnHour })];
    await sharing.refresh();
    const [share] = sharing.shares.value ?? [];
    if (share === undefined) throw new Error("no share");
    await sharing.end(share);
    expect(sharing.shares.value).toEqual([]);
    expect(sharing.ended.value).toEqual(share);
    await sharing.undo();
    const [call] = cloud.callsTo("POST", SHARES);
    expect(call?.body).toMatchObject({ account: "Bob", role: "viewer" });
    expect(call?.body["expires_in_s"]).toBeGreaterThan(3_500);
    expect(call?.body["expires_in_s"]).toBeLessThanOrEqual(3_600);
    expect(sharing.shares.value).toHaveLength(1);
    expect(sharing.ended.value).toBeNull();
  });

  it("keeps what was ended on offer when giving it back is refused", async () => {
    await sharing.end(bob());
    cloud.instead.set(`POST ${SHARES}`, () => problem(409, "too-many-shares", "There are too many."));
    await expect(sharing.undo()).rejects.toMatchObject({ code: "too-many-shares" });
    expect(sharing.ended.value).toEqual(bob());
  });

  it("shows the lists as they were, and why, when they cannot be read", async () => {
    cloud.instead.set(`GET ${INVITATIONS}`, () => problem(503, "busy", "Try again in a moment."));
    await sharing.refresh();
    expect(sharing.shares.value).toEqual([bob()]);
    expect(sharing.trouble.value).toBe("Try again in a moment.");
    cloud.instead.set(`GET ${INVITATIONS}`, () => EMPTY);
    await sharing.refresh();
    expect(sharing.trouble.value).toBe("");
  });

  it("knows what is left of a time, and of none", () => {
    expect(secondsLeft(null)).toBeNull();
    expect(secondsLeft(new Date(Date.now() + 90_500).toISOString())).toBeCloseTo(90, -1);
  });

  it("lasts a length, for good, as before, or until a date that is still to come", () => {
    expect(seconds({ choice: "workday", date: "" })).toBe(28_800);
    expect(seconds({ choice: "never", date: "" })).toBeNull();
    expect(seconds({ choice: "keep", date: "" }, 77)).toBe(77);
    expect(seconds({ choice: "date", date: "" })).toBeUndefined();
    expect(seconds({ choice: "date", date: "2001-01-01T00:00" })).toBeUndefined();
    expect(seconds({ choice: "date", date: "2999-01-01T00:00" })).toBeGreaterThan(86_400);
  });
});

describe("a followed invitation", () => {
  function shelf(): Pick<Storage, "getItem" | "setItem" | "removeItem"> & { kept: Map<string, string> } {
    const kept = new Map<string, string>();
    return {
      kept,
      getItem: (key) => kept.get(key) ?? null,
      setItem: (key, value) => kept.set(key, value),
      removeItem: (key) => kept.delete(key),
    };
  }

  it("is read from the address, and nothing else is taken for one", () => {
    expect(invitationSecret("#invitation=aB3-_x")).toBe("aB3-_x");
    for (const other of ["", "#/", "#invitation=", "#invitation=a b", "#sign-in=x", `#invitation=${"x".repeat(201)}`])
      expect(invitationSecret(other)).toBeNull();
  });

  it("is still there after signing in elsewhere has loaded the page anew, until it is answered", () => {
    const tab = shelf();
    new FollowedInvitation(tab).follow("secret");
    const again = new FollowedInvitation(tab);
    expect(again.state.value).toEqual({ kind: "open", secret: "secret", away: false });
    again.leave();
    expect(new FollowedInvitation(tab).state.value).toEqual({ kind: "open", secret: "secret", away: true });
    again.drop();
    expect(tab.kept.size).toBe(0);
    expect(new FollowedInvitation(tab).state.value).toEqual({ kind: "none" });
  });

  it("makes an account that is signed in, and says what was wrong with one that is not made", async () => {
    const session = new Session(api);
    cloud.instead.set("POST /auth/accounts", () => problem(409, "name-taken", "This name is taken."));
    await expect(session.join("secret", "Bob", "correct horse battery")).rejects.toMatchObject({ code: "name-taken" });
    expect(session.state.value.kind).not.toBe("in");
    cloud.instead.set("POST /auth/accounts", ({ body }) => ({
      status: 201,
      body: { account: { id: "demo", name: body["name"] }, session: "s1", csrf_token: cloud.csrf },
    }));
    await session.join("secret", "Bob", "correct horse battery");
    expect(session.state.value.kind).toBe("in");
    expect(cloud.callsTo("POST", "/auth/accounts")[1]?.body).toEqual({
      invitation: "secret",
      name: "Bob",
      password: "correct horse battery",
    });
  });
});

describe("the device list when a share ends", () => {
  it("asks what may be seen when the connection is cut, long before the next turn", async () => {
    const fleet = new Fleet(api);
    try {
      await until(() => fleet.link.up.value && fleet.devices.value?.size === 1, "the list and the connection");
      cloud.instead.set("GET /devices", () => EMPTY);
      cloud.cutAll();
      await until(() => fleet.devices.value?.size === 0, "the device gone from the list", 10_000);
    } finally {
      fleet.dispose();
    }
  });
});

function record(part: Partial<AuditRecord>): AuditRecord {
  return {
    seq: 1,
    at: "2026-01-31T12:00:00.000Z",
    event: "signed-in",
    target: "",
    outcome: "done",
    actor: "Ann",
    account: "account0001",
    session: "s1",
    key: "",
    data: {},
    hash: "00",
    ...part,
  };
}

describe("the record of what was done", () => {
  const AUDIT = "/accounts/me/audit";

  it("is read page by page, on over empty ones, and keeps what it has when a page fails", async () => {
    const pages = [
      { items: [], cursor: "90" },
      { items: [record({ seq: 90 })], cursor: "89" },
      { items: [record({ seq: 12 })], cursor: null },
    ];
    cloud.instead.set(`GET ${AUDIT}`, () => ({ status: 200, body: pages.shift() }));
    const reader = new AuditReader(api);
    await reader.ask({ ...ALL_ENTRIES, event: "signed-in" });
    expect(reader.records.value.map(({ seq }) => seq)).toEqual([90]);
    expect(reader.more.value).toBe(true);
    const last = cloud.instead.get(`GET ${AUDIT}`);
    cloud.instead.set(`GET ${AUDIT}`, () => problem(503, "busy", "Try again in a moment."));
    await reader.older();
    expect(reader.trouble.value).toBe("Try again in a moment.");
    expect(reader.records.value).toHaveLength(1);
    if (last !== undefined) cloud.instead.set(`GET ${AUDIT}`, last);
    await reader.older();
    expect(reader.records.value.map(({ seq }) => seq)).toEqual([90, 12]);
    expect(reader.more.value).toBe(false);
  });

  it("forgets what a filter that was left has still to bring", async () => {
    const reader = new AuditReader(api);
    cloud.instead.set(`GET ${AUDIT}`, () => ({ status: 200, body: { items: [record({ seq: 1 })], cursor: null } }));
    const first = reader.ask(ALL_ENTRIES);
    const second = reader.ask({ ...ALL_ENTRIES, event: "shared" });
    await Promise.all([first, second]);
    expect(reader.records.value).toHaveLength(1);
    expect(reader.busy.value).toBe(false);
  });

  it("names accounts that acted or were shared with, and no API key for an account", () => {
    const names = accountIdsOf([
      record({ account: "a1", actor: "Ann" }),
      record({ account: "a1", actor: "Ann (dashboard)", key: "k1" }),
      record({ account: "", actor: "", data: { with: "b2", name: "Bob" } }),
    ]);
    expect([...names]).toEqual([
      ["a1", "Ann"],
      ["b2", "Bob"],
    ]);
    expect(subjectOf("device:abc-arm")).toEqual(["device", "abc-arm"]);
    expect(subjectOf("abc-arm")).toEqual(["", "abc-arm"]);
  });

  it("says in plain words who did what to what", () => {
    const names: Names = {
      accounts: new Map([["b2", "Bob"]]),
      things: new Map([
        ["abc-arm", "Arm"],
        ["lab", "Laboratory"],
      ]),
      keys: new Map([["k1", "dashboard"]]),
    };
    const say = (event: string, part: Partial<AuditRecord> = {}): string => entryText(record({ event, ...part }), names);
    const never = { role: "operator", expires_ms: 2 ** 53 };
    expect(say("signed-in", { data: { how: "link" } })).toBe("Ann signed in with a link.");
    expect(say("shared", { target: "device:abc-arm", data: { with: "b2", ...never } })).toBe(
      "Ann shared Arm with Bob as operator, until revoked.",
    );
    expect(say("shared", { target: "space:lab", data: { with: "c3", name: "Cid", role: "viewer", expires_ms: 1e12 } })).toMatch(
      /^Ann shared Laboratory with Cid as viewer, until .*2001/,
    );
    expect(say("unshared", { target: "device:abc-arm", data: { with: "b2" } })).toBe("Ann removed Bob’s access to Arm.");
    expect(say("unshared", { target: "device:abc-arm", account: "b2", actor: "Bob", data: { with: "b2" } })).toBe(
      "Bob gave up access to Arm.",
    );
    expect(say("unshared", { target: "device:gone", actor: "", account: "", data: { with: "b2" } })).toMatch(/^Bob’s access to gone expired/);
    expect(say("api-key-made", { target: "key:k1", data: { name: "dashboard", role: "viewer", only: ["space:lab"] } })).toBe(
      "Ann created the API key “dashboard”: viewer, only Laboratory.",
    );
    expect(say("api-key-revoked", { target: "key:k1" })).toBe("Ann revoked the API key “dashboard”.");
    expect(say("stop-ordered", { data: { message: "Ann ordered a stop: test" } })).toBe("Ann ordered a stop: test");
    expect(say("something-new", { target: "abc-arm" })).toBe("Ann: something-new, Arm.");
  });
});
