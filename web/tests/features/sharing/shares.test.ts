import { beforeEach, describe, expect, it } from "vitest";
import { FollowedInvitation, invitationSecret } from "../../../src/features/sharing/model/invitation-link";
import { ShareList, secondsLeft } from "../../../src/features/sharing/model/shares";
import type { Share } from "../../../src/shared/api/sharing";
import { seconds } from "../../../src/shared/ui/duration-picker";
import { server } from "../../support/console";
import { list, none, ok, problem } from "../../support/fake-server";
import { FakeStorage } from "../../support/fake-storage";
import { DEVICE } from "../../support/messages";

const SHARES = `/devices/${DEVICE}/shares`;
const INVITATIONS = `GET /devices/${DEVICE}/invitations`;
const END = `DELETE ${SHARES}/account0002`;

function bob(part: Partial<Share> = {}): Share {
  return {
    account: { id: "account0002", name: "Bob" }, role: "operator", created_by: "Ann",
    created_at: "2026-01-31T12:00:00.000Z", expires_at: null, ...part,
  };
}

describe("shares", () => {
  let stored: Share[];
  let shares: ShareList;

  beforeEach(async () => {
    stored = [bob()];
    server.on(`GET ${SHARES}`, () => list(...stored));
    server.on(INVITATIONS, list());
    server.on(END, () => {
      stored = [];
      return none;
    });
    shares = new ShareList(server.api, { kind: "device", id: DEVICE });
    await shares.refresh();
  });

  it("report a revocation that the broker has not confirmed", async () => {
    const detail = "The share has ended. The broker did not answer.";
    server.on(END, { status: 202, body: { detail } });
    await shares.revoke(bob());
    expect(shares.pendingRevocation.value).toBe(detail);
    server.on(END, none);
    await shares.revoke(bob());
    expect(shares.pendingRevocation.value).toBe("");
  });

  it("end immediately; undo restores role and expiry", async () => {
    stored = [bob({ role: "viewer", expires_at: new Date(Date.now() + 3_600_000).toISOString() })];
    await shares.refresh();
    const [share = bob()] = stored;
    await shares.revoke(share);
    expect(shares.shares.value).toEqual([]);
    expect(shares.ended.value).toEqual(share);
    server.on(`POST ${SHARES}`, () => {
      stored = [share];
      return ok(share);
    });
    await shares.undo();
    expect(server.callsTo(`POST ${SHARES}`)[0]?.body).toEqual({ account: "Bob", role: "viewer", expires_in_s: 3_600 });
    expect(shares.shares.value).toEqual([share]);
    expect(shares.ended.value).toBeNull();
  });

  it("offer undo again if it was rejected", async () => {
    await shares.revoke(bob());
    server.on(`POST ${SHARES}`, problem(409, "too-many-shares", "There are too many."));
    await expect(shares.undo()).rejects.toMatchObject({ code: "too-many-shares" });
    expect(shares.ended.value).toEqual(bob());
  });

  it("stay on display, with the error, when they cannot be read", async () => {
    server.on(INVITATIONS, problem(503, "busy", "Try again in a moment."));
    await shares.refresh();
    expect(shares.shares.value).toEqual([bob()]);
    expect(shares.error.value).toBe("Try again in a moment.");
    server.on(INVITATIONS, list());
    await shares.refresh();
    expect(shares.error.value).toBe("");
  });

  it("last for a duration, without end, as before, or until a future date", () => {
    expect(secondsLeft(null)).toBeNull();
    expect(secondsLeft(new Date(Date.now() + 90_500).toISOString())).toBeCloseTo(90, -1);
    expect(seconds({ choice: "workday", date: "" })).toBe(28_800);
    expect(seconds({ choice: "never", date: "" })).toBeNull();
    expect(seconds({ choice: "keep", date: "" }, 77)).toBe(77);
    for (const date of ["", "2001-01-01T00:00"]) expect(seconds({ choice: "date", date })).toBeUndefined();
    expect(seconds({ choice: "date", date: "2999-01-01T00:00" })).toBeGreaterThan(86_400);
  });
});

describe("a followed invitation", () => {
  it("is read from its own fragment only", () => {
    expect(invitationSecret("#invitation=aB3-_x")).toBe("aB3-_x");
    for (const other of ["", "#/", "#invitation=", "#invitation=a b", "#sign-in=x", `#invitation=${"x".repeat(201)}`])
      expect(invitationSecret(other)).toBeNull();
  });

  it("survives a reload of the tab, such as an external sign-in, until it is answered", () => {
    const tab = new FakeStorage();
    new FollowedInvitation(tab).follow("secret");
    const reloaded = new FollowedInvitation(tab);
    expect(reloaded.state.value).toEqual({ kind: "open", secret: "secret", away: false });
    reloaded.markAway();
    expect(new FollowedInvitation(tab).state.value).toEqual({ kind: "open", secret: "secret", away: true });
    reloaded.drop();
    expect(tab.entries.size).toBe(0);
    expect(new FollowedInvitation(tab).state.value).toEqual({ kind: "none" });
  });
});
