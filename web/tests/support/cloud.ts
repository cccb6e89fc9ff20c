/**
 * As much of the cloud as the console's core needs, for its tests: the HTTP API's shapes, and a real MQTT broker over a
 * real WebSocket with exact rights for each connection. The full system is tested from the project's own test suite.
 */
import type { Action, Device, GrantedLease, Lease } from "../../src/shared/api/types";
import { randomUUID } from "node:crypto";
import { createReadStream, existsSync } from "node:fs";
import { createServer, type IncomingMessage, type ServerResponse } from "node:http";
import type { AddressInfo } from "node:net";
import { extname, join } from "node:path";
import { Aedes, type AedesPublishPacket, type Client } from "aedes";
import { createWebSocketStream, WebSocketServer } from "ws";
import type { Presence, Setpoint, Stop } from "../../src/shared/mqtt/protocol.generated";
import { matches } from "../../src/shared/mqtt/topics";
import { Arm, description } from "./arm";

export const DEVICE = "agent00001-arm";
const TOPIC = "ts/v1/lab/agent00001/arm";
const CONN = "ts/v1/lab/agent00001/conn";

interface Rights {
  password: string;
  publish: string[];
  subscribe: string[];
}

interface Answer {
  status: number;
  body: unknown;
}

/** A call as the console made it. */
export interface Call {
  method: string;
  path: string;
  body: Record<string, unknown>;
  headers: IncomingMessage["headers"];
}

interface Options {
  /** Of the credentials for watching [s]. */
  lifetimeS?: number;
  /** A folder to serve at `/`. */
  page?: string;
  port?: number;
  /** More topics that may be heard. */
  audible?: string[];
}

const TYPES: Readonly<Record<string, string>> = {
  ".html": "text/html; charset=utf-8",
  ".js": "text/javascript",
  ".css": "text/css",
  ".svg": "image/svg+xml",
};

export class Cloud {
  readonly #options: Options;
  readonly #server = createServer((request, response) => void this.#serve(request, response));
  readonly #sockets = new WebSocketServer({ noServer: true });
  readonly #rights = new Map<string, Rights>();
  readonly #clients = new Set<Client>();
  #broker: Aedes | null = null;
  #session = 1;
  arm: Arm | null = null;
  lease: (Lease & { session: string }) | null = null;
  role: Device["role"] = "owner";
  epoch = 0;
  /** Refuse connections to the broker, as if it were down. */
  brokerDown = false;
  /** What a call has to show beside the cookie when it changes something. */
  csrf = "of-this-session";
  readonly calls: Call[] = [];
  /** The number of filters of each SUBSCRIBE. */
  readonly subscribes: number[] = [];
  /** Answers that stand before the usual ones: `POST /devices/…/lease` → an answer. */
  readonly instead = new Map<string, (call: Call) => Answer>();
  readonly actions = new Map<string, Action>();

  constructor(options: Options = {}) {
    this.#options = options;
  }

  async start(): Promise<void> {
    this.#broker = await Aedes.createBroker({
      authenticate: (client, username, password, done) => {
        const rights = this.#rights.get(client.id);
        done(null, rights !== undefined && rights.password === password?.toString() && username === "account:demo");
      },
      authorizePublish: (client, packet, done) => {
        const rights = client === null ? undefined : this.#rights.get(client.id);
        const may = client === null || rights?.publish.some((filter) => matches(filter, packet.topic));
        done(may ? null : new Error("denied"));
      },
      authorizeSubscribe: (client, subscription, done) => {
        const may = this.#rights.get(client.id)?.subscribe.includes(subscription.topic);
        done(null, may ? subscription : null);
      },
    });
    this.#broker.on("publish", (packet) => this.#hear(packet));
    this.#broker.on("subscribe", (subscriptions) => this.subscribes.push(subscriptions.length));
    this.#broker.on("client", (client) => this.#clients.add(client));
    this.#broker.on("clientDisconnect", (client) => this.#clients.delete(client));
    this.#server.on("upgrade", (request, socket, head) => {
      if (this.brokerDown) {
        socket.destroy();
        return;
      }
      this.#sockets.handleUpgrade(request, socket, head, (webSocket) => {
        const stream = createWebSocketStream(webSocket);
        stream.on("error", () => undefined);
        this.#broker?.handle(stream, request);
      });
    });
    await new Promise<void>((resolve) => {
      this.#server.listen(this.#options.port ?? 0, "127.0.0.1", resolve);
    });
    this.arm = new Arm((kind, message, options) => this.tell(`${TOPIC}/${kind}`, message, options));
    this.online(true);
  }

  async stop(): Promise<void> {
    this.arm?.close();
    this.cutAll();
    await new Promise<void>((resolve) => {
      if (this.#broker === null) resolve();
      else this.#broker.close(() => resolve());
    });
    for (const socket of this.#sockets.clients) socket.terminate();
    this.#server.closeAllConnections();
    await new Promise((resolve) => this.#server.close(resolve));
  }

  get address(): string {
    return `http://127.0.0.1:${(this.#server.address() as AddressInfo).port}`;
  }

  get connections(): number {
    return this.#clients.size;
  }

  /** Ids of those connected now. */
  get clientIds(): string[] {
    return [...this.#clients].map((client) => client.id);
  }

  cutAll(): void {
    for (const client of this.#clients) client.close();
  }

  online(online: boolean): void {
    const presence: Presence = { online, session: online ? ++this.#session : this.#session, at_ms: Date.now() };
    this.tell(CONN, presence, { qos: 1, retain: true });
  }

  tell(topic: string, message: object | string, { qos, retain }: { qos: 0 | 1; retain: boolean }): void {
    const payload = Buffer.from(typeof message === "string" ? message : JSON.stringify(message));
    this.#broker?.publish({ cmd: "publish", topic, payload, qos, retain, dup: false }, () => undefined);
  }

  callsTo(method: string, path: string): Call[] {
    return this.calls.filter((call) => call.method === method && call.path === path);
  }

  #hear(packet: AedesPublishPacket): void {
    const text = packet.payload.toString();
    if (packet.topic.startsWith(`${TOPIC}/ctl/`)) this.arm?.take(JSON.parse(text) as Setpoint);
    if (packet.topic === `${TOPIC}/stop`) {
      const stop = JSON.parse(text) as Stop;
      this.arm?.latch(stop.caller, stop.reason ?? "");
    }
  }

  async #serve(request: IncomingMessage, response: ServerResponse): Promise<void> {
    const path = (request.url ?? "/").split("?")[0] ?? "/";
    if (!path.startsWith("/api/v1/")) {
      this.#file(path, response);
      return;
    }
    const chunks: Buffer[] = [];
    for await (const chunk of request) chunks.push(chunk as Buffer);
    const text = Buffer.concat(chunks).toString();
    const call: Call = {
      method: request.method ?? "",
      path: path.slice("/api/v1".length),
      body: text === "" ? {} : (JSON.parse(text) as Record<string, unknown>),
      headers: request.headers,
    };
    this.calls.push(call);
    const answer = this.instead.get(`${call.method} ${call.path}`)?.(call) ?? (await this.#answer(call, request.url ?? ""));
    const type = answer.status >= 400 ? "application/problem+json" : "application/json";
    response.writeHead(answer.status, { "Content-Type": type, "X-Telescope-Time-Ms": String(Date.now()) });
    response.end(answer.body === null ? undefined : JSON.stringify(answer.body));
  }

  #file(path: string, response: ServerResponse): void {
    const folder = this.#options.page;
    const file = folder === undefined ? undefined : join(folder, path === "/" ? "index.html" : path);
    if (file === undefined || !existsSync(file)) {
      response.writeHead(404).end();
      return;
    }
    response.writeHead(200, {
      "Content-Type": TYPES[extname(file)] ?? "application/octet-stream",
      "Content-Security-Policy":
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; " +
        `connect-src 'self' ${this.address.replace("http", "ws")}; font-src 'self'; ` +
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    });
    createReadStream(file).pipe(response);
  }

  async #answer(call: Call, url: string): Promise<Answer> {
    const { method, path, body } = call;
    if (method !== "GET" && !["/auth/sign-in", "/auth/password"].includes(path) && call.headers["x-csrf-token"] !== this.csrf)
      return problem(403, "csrf-token", "A changing request needs the session's token.");
    switch (`${method} ${path}`) {
      case "POST /auth/sign-in":
        if (body["link"] !== "good") return problem(401, "link-used", "This sign-in link was used before or is too old.");
        return ok({ account: { id: "demo", name: "Demo" }, session: "s1", csrf_token: this.csrf });
      case "POST /auth/password":
        if (body["password"] !== "right") return problem(401, "unauthorized", "This name and password do not belong together.");
        return ok({ account: { id: "demo", name: "Demo" }, session: "s1", csrf_token: this.csrf });
      case "POST /auth/sign-out":
        return { status: 204, body: null };
      case "GET /accounts/me":
        return ok({ id: "demo", name: "Demo", session: "s1", csrf_token: this.csrf });
      case "GET /devices":
        return ok({ items: [this.device()], cursor: null });
      case "GET /spaces":
        return ok({ items: [{ id: "lab", name: "Laboratory" }], cursor: null });
      case "POST /agents/claim":
        return problem(404, "claim-code-unknown", "No agent waits with this code. Codes are valid for five minutes.");
      case "POST /mqtt/credentials":
        return ok(this.#credentials(body));
      case `GET /devices/${DEVICE}/lease`:
        return ok({ lease: this.lease });
      case `POST /devices/${DEVICE}/lease`:
        return this.#lease(body);
      case `DELETE /devices/${DEVICE}/lease`:
        this.lease = null;
        this.arm?.grant(this.epoch, null);
        return { status: 204, body: null };
      case `POST /devices/${DEVICE}/stop`:
        return ok({ confirmed: false });
      case `POST /devices/${DEVICE}/stop/reset`:
        if (this.arm !== null) this.arm.stop = null;
        return ok({ confirmed: true });
      case `GET /devices/${DEVICE}/movements`:
        return ok({
          items: [
            { name: "wave", description: "Waves the hand three times.", version: 1, built_in: true },
            { name: "home", description: "Goes to the home pose.", version: 1, built_in: true },
          ],
          cursor: null,
        });
      case `POST /devices/${DEVICE}/actions`:
        return this.#act(body);
    }
    const id = /^\/actions\/([\w-]+)(\/cancel)?$/.exec(path);
    const action = this.actions.get(id?.[1] ?? "");
    if (action === undefined) return problem(404, "not-found", "There is nothing here.");
    if (id?.[2] !== undefined) action.status = "cancelled";
    // Waits as the real one does, and gives up its wait at the end.
    const until = Date.now() + Number(new URLSearchParams(url.split("?")[1]).get("wait_ms") ?? 0);
    while (Date.now() < until && action.status === "started") await new Promise((resolve) => setTimeout(resolve, 20));
    return ok(action);
  }

  device(): Device {
    return {
      id: DEVICE,
      name: "arm",
      label: "Arm by the window",
      kind: "arm",
      robot_type: description.robot_type,
      agent: "agent00001",
      space: "lab",
      role: this.role,
      owner: { id: "account0001", name: "Ann" },
      topic: TOPIC,
      online: true,
      last_seen_at: new Date().toISOString(),
      lease: this.lease,
    };
  }

  #credentials(body: Record<string, unknown>): object {
    const client = `web-${randomUUID()}`;
    const control = body["purpose"] === "control";
    const rights: Rights = {
      password: randomUUID(),
      publish: control ? [`${TOPIC}/ctl/${String(body["epoch"])}`] : [`${TOPIC}/stop`],
      subscribe: control
        ? []
        : [CONN, ...["desc", "desc/twin", "state", "tele/+", "cam/+", "event", "ack"].map((kind) => `${TOPIC}/${kind}`), ...(this.#options.audible ?? [])],
    };
    this.#rights.set(client, rights);
    return {
      client_id: client,
      username: "account:demo",
      lifetime_s: control ? 60 : (this.#options.lifetimeS ?? 900),
      websocket_url: `${this.address.replace("http", "ws")}/mqtt`,
      ...rights,
    };
  }

  #lease(body: Record<string, unknown>): Answer {
    const leaseMs = Number(body["lease_ms"]);
    const renewal = body["epoch"] !== undefined;
    if (renewal && (this.lease === null || this.lease.epoch !== body["epoch"])) {
      return problem(409, "lease-lost", "Another operator has control.");
    }
    if (!renewal && this.lease !== null && !this.lease.mine) {
      return problem(409, "lease-held", `${this.lease.holder} has control.`);
    }
    if (this.lease === null) this.epoch += 1;
    const expires = new Date(Date.now() + leaseMs).toISOString();
    this.lease = { holder: "Demo", epoch: this.epoch, expires_at: expires, mine: true, session: "s1" };
    this.arm?.grant(this.epoch, "Demo");
    const granted: GrantedLease = { epoch: this.epoch, holder: "Demo", expires_at: expires, lease_ms: leaseMs, confirmed: true };
    return ok(granted);
  }

  #act(body: Record<string, unknown>): Answer {
    const name = String((body["request"] as Record<string, unknown>)["name"]);
    const id = `${DEVICE}-${randomUUID().slice(0, 8)}`;
    const action: Action = {
      id,
      device: DEVICE,
      status: "started",
      epoch: this.epoch,
      caller: "Demo",
      reason: null,
      progress: null,
      output: "",
      result: {},
    };
    this.actions.set(id, action);
    const { arm } = this;
    if (arm !== null) arm.action = { id, kind: "run_movement", name, progress: 0 };
    const times = { at_ms: Date.now(), tick_ms: 0 };
    (["received", "accepted", "started"] as const).forEach((status, index) =>
      this.tell(`${TOPIC}/ack`, { id, status, sequence: index + 1, ...times }, { qos: 1, retain: false }),
    );
    setTimeout(() => {
      if (arm !== null) arm.action = null;
      if (action.status !== "started") return;
      action.status = "done";
      action.output = `${name}: finished\n`;
      this.tell(`${TOPIC}/ack`, { id, status: "done", sequence: 4, ...times, output: action.output }, { qos: 1, retain: false });
    }, 1500);
    return ok(action);
  }
}

function ok(body: unknown): Answer {
  return { status: 200, body };
}

export function problem(status: number, code: string, detail: string, extra: object = {}): Answer {
  return { status, body: { type: `/problems/${code}`, title: code, status, detail, ...extra } };
}
