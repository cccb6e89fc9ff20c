/** With whom one device or space is shared, and changing that. */
import { computed, signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { sentence } from "../../../shared/api/http";
import { now, toPageClock } from "../../../shared/lib/clock";
import type { Invitation, CreatedInvitation, InvitationSettings, Share, SharedRole, Target } from "../../../shared/api/sharing";

/** The shortest that the server takes [s]. */
const SHORTEST_S = 10;

/** What is left of a time that the server has set [s]; `null`: it has no end. */
export function secondsLeft(expiresAt: string | null): number | null {
  return expiresAt === null ? null : Math.floor((toPageClock(Date.parse(expiresAt)) - now()) / 1000);
}

/** All methods that change something throw `ApiError`; then nothing has changed here. */
export class ShareList {
  readonly #api: Api;
  readonly #target: Target;
  readonly #shares = signal<readonly Share[] | null>(null);
  readonly #invitations = signal<readonly Invitation[]>([]);
  readonly #trouble = signal("");
  readonly #ended = signal<Share | null>(null);
  readonly #rest = signal("");
  #asked = 0;

  /** `null` until the first answer. */
  readonly shares: ReadonlySignal<readonly Share[] | null> = this.#shares;
  /** Those that can still be redeemed. */
  readonly invitations: ReadonlySignal<readonly Invitation[]> = this.#invitations;
  /** Why the lists could not be read the last time; empty when they could. */
  readonly trouble: ReadonlySignal<string> = this.#trouble;
  /** What was ended last and can be given back, with what was left of its time. */
  readonly ended: ReadonlySignal<Share | null> = this.#ended;
  /** The server's message about an unfinished revocation; empty if complete. */
  readonly rest: ReadonlySignal<string> = this.#rest;
  /** Whether invitations are open, which can be redeemed at any time, so that the lists need polling. */
  readonly waits = computed(() => this.#invitations.value.length > 0);

  constructor(api: Api, target: Target) {
    this.#api = api;
    this.#target = target;
  }

  async refresh(): Promise<void> {
    const asked = ++this.#asked;
    try {
      const [shares, invitations] = await Promise.all([
        this.#api.shares(this.#target),
        this.#api.invitations(this.#target),
      ]);
      // An answer to an older question must not undo what was learnt since.
      if (asked !== this.#asked) return;
      this.#shares.value = shares;
      this.#invitations.value = invitations;
      this.#trouble.value = "";
    } catch (error) {
      if (asked === this.#asked) this.#trouble.value = sentence(error);
    }
  }

  /** Shares the device or space with an account, or changes its role; `forS` null: no expiry [s]. */
  async put(account: string, role: SharedRole, forS: number | null): Promise<Share> {
    const share = await this.#api.share(this.#target, account, role, forS);
    if (this.#ended.value?.account.id === share.account.id) this.#ended.value = null;
    await this.refresh();
    return share;
  }

  async end(share: Share): Promise<void> {
    this.#rest.value = await this.#api.unshare(this.#target, share.account.id);
    this.#ended.value = share;
    await this.refresh();
  }

  /** Give back what was ended last, until when it was. */
  async undo(): Promise<void> {
    const share = this.#ended.value;
    if (share === null) return;
    const left = secondsLeft(share.expires_at);
    await this.put(share.account.name, share.role, left === null ? null : Math.max(left, SHORTEST_S));
  }

  async invite(wanted: InvitationSettings): Promise<CreatedInvitation> {
    const made = await this.#api.invite(this.#target, wanted);
    await this.refresh();
    return made;
  }

  async withdraw(invitation: Invitation): Promise<void> {
    await this.#api.withdrawInvitation(this.#target, invitation.id);
    await this.refresh();
  }
}
