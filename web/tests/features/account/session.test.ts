import { describe, expect, it } from "vitest";
import { Api } from "../../../src/shared/api/client";
import { ApiError } from "../../../src/shared/api/http";
import { Session } from "../../../src/features/account/model/session";
import { DEVICE, problem } from "../../support/cloud";
import { api, cloud } from "../../support/console";

describe("a session", () => {
  it("starts with a sign-in link and ends at sign-out", async () => {
    const session = new Session(api);
    await session.start("good");
    expect(session.state.value).toMatchObject({ kind: "in", account: { name: "Demo" } });
    await session.signOut();
    expect(session.state.value).toEqual({ kind: "out", why: "" });
  });

  it("signs in with a name and a password, or rejects them", async () => {
    const session = new Session(api);
    await expect(session.enter("demo", "wrong")).rejects.toMatchObject({ status: 401 });
    expect(session.state.value.kind).not.toBe("in");
    await session.enter("demo", "right");
    expect(session.state.value).toMatchObject({ kind: "in", account: { name: "Demo" } });
  });

  it("shows an external sign-in error only while signed out", async () => {
    const session = new Session(api);
    await session.start(null, "Not there.");
    expect(session.state.value.kind).toBe("in");
    cloud.instead.set("GET /accounts/me", () => problem(401, "unauthorized", "Sign in first."));
    await session.start(null, "Not there.");
    expect(session.state.value).toEqual({ kind: "out", why: "Not there." });
  });

  it("reports why a sign-in link failed, and shows no error on a first visit", async () => {
    const session = new Session(api);
    await session.start("used");
    expect(session.state.value).toMatchObject({ kind: "out", why: expect.stringContaining("used before") as string });
    cloud.instead.set("GET /accounts/me", () => problem(401, "signed-out", "You are not signed in."));
    await session.start(null);
    expect(session.state.value).toEqual({ kind: "out", why: "" });
  });

  it("sends the CSRF token with changing requests only", () => {
    const [call] = cloud.callsTo("POST", "/mqtt/credentials");
    expect(call?.headers["x-csrf-token"]).toBe("of-this-session");
    expect(cloud.callsTo("GET", "/devices")[0]?.headers["x-csrf-token"]).toBeUndefined();
  });

  it("retries once with the CSRF token of a session that another tab started", async () => {
    cloud.csrf = "of-another-session";
    expect((await api.stop(DEVICE, "test")).confirmed).toBe(false);
    expect(cloud.callsTo("POST", `/devices/${DEVICE}/stop`)).toHaveLength(2);
    cloud.instead.set(`POST /devices/${DEVICE}/stop`, () => problem(403, "csrf-token", "No."));
    await expect(api.stop(DEVICE, "test")).rejects.toMatchObject({ status: 403, code: "csrf-token" });
    expect(cloud.callsTo("POST", `/devices/${DEVICE}/stop`)).toHaveLength(4);
  });

  it("distinguishes an unreachable server from a rejection", async () => {
    const away = new Api("http://127.0.0.1:9/api/v1");
    await expect(away.me()).rejects.toMatchObject({ status: 0, code: "unreachable" });
    await expect(api.claim("BCDF-GHJK")).rejects.toMatchObject({ status: 404, code: "claim-code-unknown" });
    await expect(api.claim("BCDF-GHJK")).rejects.toBeInstanceOf(ApiError);
  });
});
