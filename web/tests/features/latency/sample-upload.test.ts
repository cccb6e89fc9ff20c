import { describe, expect, it } from "vitest";
import { RoundTrip } from "../../../src/features/latency/model/round-trip";
import { LatencySamples } from "../../../src/features/latency/model/sample-upload";
import { DEVICE, problem } from "../../support/cloud";
import { api, cloud, ends } from "../../support/console";

describe("latency samples", () => {
  it("are sent in one batch; a failed batch is sent again with the same idempotency key", async () => {
    const path = `/devices/${DEVICE}/latency`;
    cloud.instead.set(`POST ${path}`, () => problem(503, "busy", "Later."));
    const roundTrip = new RoundTrip();
    const samples = new LatencySamples(api, DEVICE, roundTrip, 600_000);
    ends.push(() => samples.dispose());
    await samples.send();
    expect(cloud.callsTo("POST", path)).toEqual([]);
    roundTrip.seen(1, 1000, 1012);
    roundTrip.seen(2, 1020, 1035);
    await samples.send();
    cloud.instead.set(`POST ${path}`, () => ({ status: 204, body: null }));
    await samples.send();
    const [first, again, ...more] = cloud.callsTo("POST", path);
    expect(first?.body).toMatchObject({ transport: "websocket", path: "operator-device", samples: [{ ms: 12 }, { ms: 15 }] });
    expect(again?.body).toEqual(first?.body);
    expect(again?.headers["idempotency-key"]).toBe(first?.headers["idempotency-key"]);
    expect(more).toEqual([]);
    // Of the call that arrived the time is known too, and goes with the next.
    await samples.send();
    expect(cloud.callsTo("POST", path)[2]?.body).toMatchObject({ transport: "http", path: "operator-cloud" });
  });
});
