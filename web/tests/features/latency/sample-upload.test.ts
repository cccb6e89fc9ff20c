import { expect, it } from "vitest";
import { RoundTrip } from "../../../src/features/latency/model/round-trip";
import { LatencySamples } from "../../../src/features/latency/model/sample-upload";
import { ends, server } from "../../support/console";
import { none, problem } from "../../support/fake-server";
import { DEVICE } from "../../support/messages";

it("uploads latency samples in one batch; a failed batch is sent again with the same idempotency key", async () => {
  const route = `POST /devices/${DEVICE}/latency`;
  server.on(route, problem(503, "busy", "Later."));
  const roundTrip = new RoundTrip();
  const samples = new LatencySamples(server.api, DEVICE, roundTrip, 600_000);
  ends.push(() => samples.dispose());
  await samples.send();
  expect(server.callsTo(route)).toEqual([]);
  roundTrip.add(1, 1000, 1012);
  roundTrip.add(2, 1020, 1035);
  await samples.send();
  server.on(route, none);
  await samples.send();
  const [first, again, ...more] = server.callsTo(route);
  expect(first?.body).toMatchObject({ transport: "websocket", path: "operator-device", samples: [{ ms: 12 }, { ms: 15 }] });
  expect(again?.body).toEqual(first?.body);
  expect(again?.headers["Idempotency-Key"]).toBe(first?.headers["Idempotency-Key"]);
  expect(more).toEqual([]);
  // The duration of the call that arrived is itself a sample.
  await samples.send();
  expect(server.callsTo(route)[2]?.body).toMatchObject({ transport: "http", path: "operator-cloud" });
});
