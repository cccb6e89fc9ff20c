import { beforeEach, describe, expect, it } from "vitest";
import { KnownBrowser } from "../../../src/features/account/model/known-browser";
import { Session, signInFailure, signInToken } from "../../../src/features/account/model/session";
import { server } from "../../support/console";
import { FakeStorage } from "../../support/fake-storage";
import { none, ok, problem, unreachable } from "../../support/fake-server";
import { DEVICE } from "../../support/messages";

const STOP = `/devices/${DEVICE}/stop`;
const CSRF = "of-this-session";

let session: Session;
let browser: FakeStorage;

beforeEach(() => {
  const signedIn = ok({ account: { id: "demo", name: "Demo" }, session: "s1", csrf_token: CSRF, device_token: "known" });
  server.on("POST /auth/sign-in", ({ body }) => (body["link"] === "good" ? signedIn : problem(401, "link-used", "This link was used before.")));
  server.on("POST /auth/password", ({ body }) => (body["password"] === "right" ? signedIn : problem(401, "unauthorized", "Wrong password.")));
  server.on("POST /auth/sign-out", none);
  server.on("GET /accounts/me", ok({ id: "demo", name: "Demo", session: "s1", csrf_token: CSRF }));
  browser = new FakeStorage();
  session = new Session(server.api, new KnownBrowser(browser));
});

describe("a session", () => {
  it("starts with a sign-in link and ends at sign-out", async () => {
    await session.start("good");
    expect(session.state.value).toMatchObject({ kind: "in", account: { name: "Demo" } });
    await session.signOut();
    expect(session.state.value).toEqual({ kind: "out", reason: "" });
  });

  it("signs in with a name and a password, or rejects them", async () => {
    await expect(session.signInWithPassword("demo", "wrong")).rejects.toMatchObject({ status: 401 });
    expect(session.state.value.kind).not.toBe("in");
    await session.signInWithPassword("demo", "right");
    expect(session.state.value).toMatchObject({ kind: "in", account: { name: "Demo" } });
  });

  it("asks for the code of a second factor and repeats the sign-in with it", async () => {
    const signedIn = ok({ account: { id: "demo", name: "Demo" }, session: "s1", csrf_token: CSRF, device_token: "known" });
    const guarded = ({ body }: { body: Record<string, unknown> }) => {
      if (body["code"] === "123456") return signedIn;
      return body["code"] === undefined ? problem(403, "second-factor-required", "Enter it.") : problem(403, "second-factor-wrong", "Wrong.");
    };
    server.on("POST /auth/password", guarded);
    server.on("POST /auth/sign-in", guarded);
    for (const begin of [() => session.signInWithPassword("demo", "right"), () => session.start("good")]) {
      await begin();
      expect(session.state.value).toEqual({ kind: "code" });
      await expect(session.submitCode("000000")).rejects.toMatchObject({ code: "second-factor-wrong" });
      expect(session.state.value).toEqual({ kind: "code" });
      await session.submitCode("123456");
      expect(session.state.value.kind).toBe("in");
    }
    await session.start("good");
    session.cancelCode();
    expect(session.state.value).toEqual({ kind: "out", reason: "" });
  });

  it("identifies this browser at the next sign-in to the same account", async () => {
    await session.signInWithPassword("Demo", "right");
    await session.signInWithPassword("demo ", "right");
    await session.signInWithPassword("other", "right");
    await session.start("good");
    expect(server.callsTo("POST /auth/password").map(({ body }) => body["device_token"])).toEqual([undefined, "known", undefined]);
    expect(server.callsTo("POST /auth/sign-in")[0]?.body).toMatchObject({ device_token: "known" });
  });

  it("starts with a new account of an invitation, or reports why there is none", async () => {
    server.on("POST /auth/accounts", problem(409, "name-taken", "This name is taken."));
    await expect(session.createAccount("secret", "Bob", "correct horse battery")).rejects.toMatchObject({ code: "name-taken" });
    expect(session.state.value.kind).not.toBe("in");
    server.on("POST /auth/accounts", ok({ account: { id: "bob", name: "Bob" }, session: "s1", csrf_token: CSRF, device_token: "known" }));
    await session.createAccount("secret", "Bob", "correct horse battery");
    expect(session.state.value.kind).toBe("in");
    expect(server.callsTo("POST /auth/accounts")[1]?.body).toEqual({ invitation: "secret", name: "Bob", password: "correct horse battery" });
  });

  it("shows an external sign-in error only while signed out", async () => {
    await session.start(null, "Not there.");
    expect(session.state.value.kind).toBe("in");
    server.on("GET /accounts/me", problem(401, "unauthorized", "Sign in first."));
    await session.start(null, "Not there.");
    expect(session.state.value).toEqual({ kind: "out", reason: "Not there." });
  });

  it("reports why a sign-in link failed, and shows no error on a first visit", async () => {
    await session.start("used");
    expect(session.state.value).toEqual({ kind: "out", reason: expect.stringContaining("used before") as string });
    server.on("GET /accounts/me", problem(401, "signed-out", "You are not signed in."));
    await session.start(null);
    expect(session.state.value).toEqual({ kind: "out", reason: "" });
  });
});

describe("calls", () => {
  it("carry the CSRF token if they change something, and are repeated once with the token of another tab's session", async () => {
    await session.start(null);
    let csrf = "of-another-session";
    server.on("GET /accounts/me", () => ok({ id: "demo", name: "Demo", session: "s2", csrf_token: csrf }));
    server.on(`POST ${STOP}`, ({ headers }) => (headers["X-CSRF-Token"] === "of-another-session" ? ok({ outcome: "sent" }) : problem(403, "csrf-token", "No.")));
    expect((await server.api.stop(DEVICE, "test")).outcome).toBe("sent");
    expect(server.callsTo(`POST ${STOP}`).map(({ headers }) => headers["X-CSRF-Token"])).toEqual([CSRF, csrf]);
    expect(server.callsTo("GET /accounts/me")[0]?.headers).not.toHaveProperty("X-CSRF-Token");
    csrf = "wrong";
    server.on(`POST ${STOP}`, problem(403, "csrf-token", "No."));
    await expect(server.api.stop(DEVICE, "test")).rejects.toMatchObject({ status: 403, code: "csrf-token" });
    expect(server.callsTo(`POST ${STOP}`)).toHaveLength(4);
  });

  it("distinguish an unreachable server from a rejection", async () => {
    server.on("POST /agents/claim", problem(404, "claim-code-unknown", "No agent waits with this code."));
    await expect(server.api.claim("BCDF-GHJK")).rejects.toMatchObject({ name: "ApiError", status: 404, code: "claim-code-unknown" });
    server.on("POST /agents/claim", unreachable);
    await expect(server.api.claim("BCDF-GHJK")).rejects.toMatchObject({ name: "ApiError", status: 0, code: "unreachable" });
  });
});

describe("sign-in fragments", () => {
  it("contain a well-formed error code of an external sign-in, or a sign-in token", () => {
    expect(signInFailure("#sign-in-failed=oidc-expired")).toBe("oidc-expired");
    for (const hash of ["", "#/", "#sign-in-failed=", "#sign-in-failed=<b>"]) expect(signInFailure(hash)).toBeNull();
    expect(signInToken("#sign-in=abc-_%2B")).toBe("abc-_+");
    for (const hash of ["", "#/", "#sign-in=", "#x&sign-in=abc", "#sign-in=%"]) expect(signInToken(hash)).toBeNull();
  });
});
