/**
 * One XMPP stream of an operator over WebSocket (RFC 7395), signed in at a gateway of the cloud: see
 * docs/reference/brokers/xmpp.md. Stanzas equal those of device_agent/protocol/xmpp/operator_stanzas.py.
 */
import type { XmppCredentials } from "../api/types";
import { now } from "../lib/clock";

type Library = typeof import("strophe.js");
type Connection = InstanceType<Library["Strophe"]["Connection"]>;
type Stanza = Parameters<Parameters<Connection["addHandler"]>[0]>[0];
type Builder = ReturnType<Library["$msg"]>;

const NAMESPACE = "urn:telescope:v1";
const CONNECT_TIMEOUT_MS = 8_000;
/** Interval of pings, and the age of an unanswered ping at which the stream counts as lost, as at the agent [ms]. */
const PING_MS = 2_500;
const DEAD_AFTER_MS = 7_000;
/** Interval of the check whether the socket has sent its data [ms]. */
const DRAIN_POLL_MS = 5;
const LOST = "The connection to the XMPP server was lost.";

interface Waiting {
  resolve: () => void;
  reject: (reason: Error) => void;
}

/** Call `open` once; `lost` is called at most once, after `open` has resolved. */
export class XmppStream {
  readonly openedAt = now();
  readonly #library: Library;
  readonly #connection: Connection;
  readonly #credentials: XmppCredentials;
  readonly #lost: (stream: XmppStream, reason: string) => void;
  readonly #requests = new Map<string, Waiting>();
  #signIns = 0;
  #gateway = "";
  #onGateway: () => void = () => undefined;
  #fail: (reason: Error) => void = () => undefined;
  #ended = false;
  #pingTimer: ReturnType<typeof setInterval> | undefined;
  #pingedAt: number | null = null;

  private constructor(library: Library, credentials: XmppCredentials, lost: (stream: XmppStream, reason: string) => void) {
    this.#library = library;
    this.#credentials = credentials;
    this.#lost = lost;
    const { Strophe } = library;
    Strophe.setLogLevel(Strophe.LogLevel.FATAL);
    // The password is a token that the server passes on, so no other mechanism works.
    this.#connection = new Strophe.Connection(credentials.websocket_url, { mechanisms: [Strophe.SASLPlain] });
  }

  /** Connects, and signs in at a gateway. Rejects with a reason for the operator. */
  static async open(
    credentials: XmppCredentials,
    closing: AbortSignal,
    lost: (stream: XmppStream, reason: string) => void,
  ): Promise<XmppStream> {
    const library = await import("strophe.js");
    closing.throwIfAborted();
    const stream = new XmppStream(library, credentials, lost);
    const abort = (): void => stream.#end(LOST);
    const timer = setTimeout(() => stream.#end("The XMPP server or its gateway did not respond."), CONNECT_TIMEOUT_MS);
    closing.addEventListener("abort", abort);
    try {
      await stream.#connect();
      await stream.signIn(credentials.token);
      stream.#pingTimer = setInterval(() => stream.#ping(), PING_MS);
      return stream;
    } catch (error) {
      stream.close();
      throw error;
    } finally {
      clearTimeout(timer);
      closing.removeEventListener("abort", abort);
    }
  }

  /** Starts the session at the gateway, or renews its token. Rejects if the gateway refuses it. */
  async signIn(token: string): Promise<void> {
    this.#signIns += 1;
    const id = `sign-in-${this.#signIns}`;
    await new Promise<void>((resolve, reject) => {
      this.#requests.set(id, { resolve, reject });
      this.#send(this.#message(id).c("sign-in", { xmlns: NAMESPACE, token }));
    });
  }

  /** Sends a message of a topic. Resolves when the socket has sent it. */
  async publish(topic: string, text: string): Promise<void> {
    this.#send(this.#message().c("m", { xmlns: NAMESPACE, topic }).t(text));
    while (!this.#ended && this.#unsentBytes > 0) await new Promise((resolve) => setTimeout(resolve, DRAIN_POLL_MS));
    if (this.#ended) throw new Error(LOST);
  }

  close(): void {
    if (this.#ended) return;
    this.#ended = true;
    clearInterval(this.#pingTimer);
    this.#connection.disconnect();
  }

  #connect(): Promise<void> {
    const { $pres, Strophe } = this.#library;
    const { Status } = Strophe;
    return new Promise((resolve, reject) => {
      this.#fail = reject;
      this.#onGateway = resolve;
      this.#connection.connect(this.#credentials.jid, this.#credentials.password, (status) => {
        if (status === Status.CONNECTED) {
          this.#connection.addHandler((stanza) => this.#onMessage(stanza), null, "message", null);
          this.#connection.addHandler((stanza) => this.#onPresence(stanza), null, "presence", null);
          // A negative priority keeps the server from routing other messages to this page.
          this.#send($pres().c("priority").t("-1"));
        } else if (status === Status.AUTHFAIL) {
          this.#end("The XMPP server rejected the credentials.");
        } else if (status === Status.CONNFAIL) {
          this.#end("The XMPP server cannot be reached.");
        } else if (status === Status.DISCONNECTED || status === Status.ERROR) {
          this.#end(LOST);
        }
      });
    });
  }

  #message(id?: string): Builder {
    return this.#library.$msg(id === undefined ? { to: this.#gateway } : { to: this.#gateway, id });
  }

  #send(stanza: Builder): void {
    if (this.#ended) throw new Error(LOST);
    this.#connection.send(stanza);
    this.#connection.flush();
  }

  get #unsentBytes(): number {
    // The library does not offer this figure; without it, setpoints would queue in a slow socket.
    const transport = this.#connection._proto as { socket?: { bufferedAmount?: number } | null };
    return transport.socket?.bufferedAmount ?? 0;
  }

  #onPresence(stanza: Stanza): true {
    const from = stanza.getAttribute("from") ?? "";
    const type = stanza.getAttribute("type");
    if (type === null && this.#gateway === "" && from.startsWith(`${this.#credentials.cloud}/`)) {
      this.#gateway = from;
      this.#onGateway();
    } else if (type === "unavailable" && from === this.#gateway) {
      this.#end("The XMPP gateway was disconnected.");
    }
    return true;
  }

  #onMessage(stanza: Stanza): true {
    if (stanza.getAttribute("from") !== this.#gateway) return true;
    if (stanza.getAttribute("type") === "error") {
      // A setpoint did not arrive: the lease has ended, or the gateway has left.
      const reason = stanza.getElementsByTagName("text")[0]?.textContent ?? "";
      this.#end(reason === "" ? "The XMPP gateway rejected a setpoint." : reason);
      return true;
    }
    const answer = stanza.getElementsByTagName("answer")[0];
    const request = this.#requests.get(stanza.getAttribute("id") ?? "");
    if (answer === undefined || request === undefined) return true;
    this.#requests.delete(stanza.getAttribute("id") ?? "");
    if (Number(answer.getAttribute("status")) < 400) request.resolve();
    else request.reject(new Error(`The XMPP gateway rejected the sign-in: ${detail(answer.textContent)}`));
    return true;
  }

  #ping(): void {
    if (this.#pingedAt !== null) {
      if (now() - this.#pingedAt > DEAD_AFTER_MS) this.#end("The XMPP server does not respond.");
      return;
    }
    this.#pingedAt = now();
    const answered = (): void => void (this.#pingedAt = null);
    const ping = this.#library.$iq({ type: "get", to: this.#connection.domain ?? "" }).c("ping", { xmlns: "urn:xmpp:ping" });
    this.#connection.sendIQ(ping, answered, answered);
  }

  #end(reason: string): void {
    if (this.#ended) return;
    this.close();
    const error = new Error(reason);
    this.#fail(error);
    for (const { reject } of this.#requests.values()) reject(error);
    this.#requests.clear();
    this.#lost(this, reason);
  }
}

/** The reason in a problem of the HTTP API. */
function detail(text: string): string {
  try {
    return (JSON.parse(text) as { detail?: string }).detail ?? "";
  } catch {
    return "";
  }
}
