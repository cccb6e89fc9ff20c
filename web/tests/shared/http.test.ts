import { afterEach, beforeEach, expect, test, vi } from "vitest";
import { Http } from "../../src/shared/api/http";
import { FakeServer, ok, problem } from "../support/fake-server";

let server: FakeServer;
const http = new Http("");

beforeEach(() => {
  server = new FakeServer();
});
afterEach(() => {
  vi.unstubAllGlobals();
});

test("each change begins a trace of its own, whose id is the request id", async () => {
  server.on("POST /devices/d/stop", ok({}));
  await http.call("POST", "/devices/d/stop");
  await http.call("POST", "/devices/d/stop");
  const traces = server.calls.map(({ headers }) => {
    const [, trace, span] = /^00-([0-9a-f]{32})-([0-9a-f]{16})-01$/.exec(headers["traceparent"] ?? "") ?? [];
    expect(headers["X-Request-Id"]).toBe(trace);
    return [trace, span];
  });
  expect(new Set(traces.flat()).size).toBe(4);
});

test("reading is not traced", async () => {
  server.on("GET /devices", ok([]));
  await http.call("GET", "/devices");
  expect(Object.keys(server.calls[0]?.headers ?? {})).toEqual(["Accept"]);
});

test("only an unexpected error shows the id of its request", async () => {
  const headers = { "X-Request-Id": "r1" };
  server.on("POST /a", { ...problem(500, "internal", "The server failed."), headers });
  server.on("POST /b", { ...problem(409, "device-busy", "The device is busy."), headers });
  await expect(http.call("POST", "/a")).rejects.toThrow("The server failed. Request ID: r1");
  await expect(http.call("POST", "/b")).rejects.toThrow(/^The device is busy\.$/);
});
