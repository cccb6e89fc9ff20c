/** Both connections for setpoints behave alike. */
import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { ApiError } from "../../src/shared/api/http";
import { MqttLink, type LinkState, type SetpointLink } from "../../src/shared/mqtt/mqtt-link";
import { XmppLink } from "../../src/shared/xmpp/xmpp-link";
import { Broker } from "../support/broker";
import { XmppServer } from "../support/xmpp-server";

const TOPIC = "ts/v1/lab/a1/arm/ctl/7";
const NO_LEASE = new ApiError(409, "lease-lost", "You do not have control.");

const until = (condition: () => boolean): Promise<boolean> => vi.waitUntil(condition, { timeout: 15_000, interval: 5 });

interface Transport {
  server: Broker | XmppServer;
  /** `fail`: the error of each request for credentials. */
  open: (fail?: () => Error | null) => SetpointLink;
}

function mqtt(): Transport {
  const server = new Broker();
  return { server, open: (fail = () => null) => new MqttLink(() => failing(fail, server.credentials)) };
}

function xmpp(): Transport {
  const server = new XmppServer();
  return { server, open: (fail = () => null) => new XmppLink(() => failing(fail, server.credentials)) };
}

function failing<T>(fail: () => Error | null, credentials: () => Promise<T>): Promise<T> {
  const error = fail();
  return error === null ? credentials() : Promise.reject(error);
}

describe.each([["mqtt", mqtt], ["xmpp", xmpp]] as const)("the connection for setpoints over %s", (name, start) => {
  let transport: Transport;
  let server: Broker | XmppServer;
  let links: SetpointLink[];

  beforeEach(async () => {
    links = [];
    transport = start();
    ({ server } = transport);
    await server.start();
  });

  afterEach(async () => {
    for (const link of links) link.close();
    await server.stop();
  });

  function open(fail?: () => Error | null): SetpointLink {
    const link = transport.open(fail);
    links.push(link);
    return link;
  }

  const isUp = (link: SetpointLink): boolean => link.status.value.state === "up";

  it("publishes immediately or not at all", async () => {
    const link = open();
    expect(link.transport).toBe(name);
    await expect(link.publish(TOPIC, {}, 0)).rejects.toThrow(/no connection/);
    await until(() => isUp(link));
    await link.publish(TOPIC, { a: 1 }, 0);
    await until(() => server.published.length === 1);
    expect(server.published).toEqual([TOPIC]);
  });

  it("reconnects with new credentials after a loss, and delivers nothing that was sent meanwhile", async () => {
    const link = open();
    await until(() => isUp(link));
    const [first] = server.clientIds;
    server.down = true;
    server.cutAll();
    await until(() => link.status.value.state === "down" && server.issued > 1);
    expect(link.status.value.reason).not.toBe("");
    await expect(link.publish(TOPIC, {}, 0)).rejects.toThrow(/no connection/);
    server.down = false;
    await until(() => isUp(link));
    expect(server.clientIds).not.toContain(first);
    expect(server.published).toEqual([]);
    await link.publish(TOPIC, {}, 0);
    await until(() => server.published.length === 1);
  });

  it("reconnects if the server is unavailable at first", async () => {
    server.down = true;
    const link = open();
    await until(() => link.status.value.state === "down");
    server.down = false;
    await until(() => isUp(link));
  });

  it("renews its rights before they expire, without an interruption", async () => {
    server.lifetimeS = 1.5;
    const link = open();
    const states = new Set<LinkState>();
    await until(() => isUp(link));
    link.status.subscribe((status) => states.add(status.state));
    await until(() => server.issued >= 3);
    await link.publish(TOPIC, {}, 0);
    await until(() => server.published.length === 1);
    expect([...states]).toEqual(["up"]);
  });

  it("is refused without a lease, also after a loss", async () => {
    const refused = open(() => NO_LEASE);
    await until(() => refused.status.value.state === "refused");
    expect(refused.status.value.reason).toBe("You do not have control.");
    let error: Error | null = null;
    const link = open(() => error);
    await until(() => isUp(link));
    error = NO_LEASE;
    server.cutAll();
    await until(() => link.status.value.state === "refused");
    await expect(link.publish(TOPIC, {}, 0)).rejects.toThrow(/no connection/);
  });

  it("leaves no connection after it was closed, also while it connects", async () => {
    const link = open();
    await until(() => isUp(link));
    open().close();
    link.close();
    expect(link.status.value.state).toBe("closed");
    await until(() => server.clientIds.length === 0);
    await expect(link.publish(TOPIC, {}, 0)).rejects.toThrow(/no connection/);
  });
});
