/** The shares and invitations of one device or space. */
import { computed, signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { sentence } from "../../../shared/api/http";
import { now, toPageClock } from "../../../shared/lib/clock";
import type { Invitation, CreatedInvitation, InvitationSettings, Share, SharedRole, Target } from "../../../shared/api/sharing";

/** The server's minimum share duration [s]. */
const MIN_DURATION_S = 10;

/** Remaining time until the server's expiry time [s]; `null`: no expiry. */
export function secondsLeft(expiresAt: string | null): number | null {
  return expiresAt === null ? null : Math.floor((toPageClock(Date.parse(expiresAt)) - now()) / 1000);
}

/** Methods with a request throw `ApiError` and then leave the lists unchanged. */
export class ShareList {
  readonly #api: Api;
  readonly #target: Target;
  readonly #shares = signal<readonly Share[] | null>(null);
  readonly #invitations = signal<readonly Invitation[]>([]);
  readonly #error = signal("");
  readonly #ended = signal<Share | null>(null);
  readonly #pendingRevocation = signal("");
  #generation = 0;

  /** `null` until the first response. */
  readonly shares: ReadonlySignal<readonly Share[] | null> = this.#shares;
  /** The invitations that can still be redeemed. */
  readonly invitations: ReadonlySignal<readonly Invitation[]> = this.#invitations;
  /** The error of the last load, or "". */
  readonly error: ReadonlySignal<string> = this.#error;
  /** The share that was ended last, which `undo` can restore; `null`: none. */
  readonly ended: ReadonlySignal<Share | null> = this.#ended;
  /** The server's message about an unfinished revocation; empty if complete. */
  readonly pendingRevocation: ReadonlySignal<string> = this.#pendingRevocation;
  /** Whether invitations are open, which can be redeemed at any time, so that the lists need polling. */
  readonly hasInvitations = computed(() => this.#invitations.value.length > 0);

  constructor(api: Api, target: Target) {
    this.#api = api;
    this.#target = target;
  }

  async refresh(): Promise<void> {
    const generation = ++this.#generation;
    try {
      const [shares, invitations] = await Promise.all([
        this.#api.shares(this.#target),
        this.#api.invitations(this.#target),
      ]);
      // Discard the response to an older request.
      if (generation !== this.#generation) return;
      this.#shares.value = shares;
      this.#invitations.value = invitations;
      this.#error.value = "";
    } catch (error) {
      if (generation === this.#generation) this.#error.value = sentence(error);
    }
  }

  /** Shares the device or space with an account, or changes its role; `forS` null: no expiry [s]. */
  async share(account: string, role: SharedRole, forS: number | null): Promise<Share> {
    const share = await this.#api.share(this.#target, account, role, forS);
    if (this.#ended.value?.account.id === share.account.id) this.#ended.value = null;
    await this.refresh();
    return share;
  }

  async revoke(share: Share): Promise<void> {
    this.#pendingRevocation.value = await this.#api.unshare(this.#target, share.account.id);
    this.#ended.value = share;
    await this.refresh();
  }

  /** Restores the share that was ended last, with its role and expiry. */
  async undo(): Promise<void> {
    const share = this.#ended.value;
    if (share === null) return;
    const remaining = secondsLeft(share.expires_at);
    await this.share(share.account.name, share.role, remaining === null ? null : Math.max(remaining, MIN_DURATION_S));
  }

  async invite(terms: InvitationSettings): Promise<CreatedInvitation> {
    const created = await this.#api.invite(this.#target, terms);
    await this.refresh();
    return created;
  }

  async withdraw(invitation: Invitation): Promise<void> {
    await this.#api.withdrawInvitation(this.#target, invitation.id);
    await this.refresh();
  }
}
