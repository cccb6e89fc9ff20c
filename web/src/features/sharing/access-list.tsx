import type { Account } from "../../shared/api/types";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { ApiError, sentence } from "../../shared/api/http";
import type { Invitation, Person, Role, Share, SharedRole, Target } from "../../shared/api/sharing";
import { secondsLeft, ShareList } from "./model/shares";
import type { Transferable } from "../../shared/api/transfers";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { accountLabel, shortId } from "../../shared/lib/account-label";
import { texts } from "./texts";
import { InlineForm } from "../../shared/ui/inline-form";
import { ConfirmButton } from "../../shared/ui/confirm-button";
import { useReturnFocus } from "../../shared/hooks/use-return-focus";
import { InviteForm, SHARED_ROLES } from "./invite-form";
import { UNCHANGED, DurationPicker, seconds } from "../../shared/ui/duration-picker";
import { spaceAddress } from "../../shared/routing/routes";
import { TransferPanel } from "./transfer-panel";
import "./sharing.css";

/** An open invitation can be redeemed at any time, so the list is polled at this interval [ms]. */
const REFRESH_MS = 5_000;
const DURATIONS = ["keep", "never", "hour", "workday", "day", "week", "month", "date"] as const;

interface AccessProps {
  api: Api;
  account: Account;
  target: Target;
  /** The unit of an ownership transfer, and the names of the included devices. */
  unit: Transferable;
  included: readonly string[];
  owner: Person;
  role: Role;
  /** For a device: the space through which other accounts have access. */
  space?: { id: string; name: string };
  /** The user gave up their own access. */
  onLeft: () => void;
}

type PartProps = Omit<AccessProps, "included" | "role" | "unit">;

const ID = "access";

/** Scrolls to the access list and focuses it. A link cannot do this, because the fragment holds the route. */
export function goToAccess(): void {
  const card = document.getElementById(ID);
  card?.scrollIntoView({ block: "start" });
  card?.querySelector<HTMLElement>("button, input")?.focus({ preventScroll: true });
}

/** The access list of a device or space, with the owner's controls. */
export function AccessList({ role, unit, included, ...rest }: AccessProps) {
  return (
    <div id={ID} class="access" data-testid="access">
      {role === "owner" ? <OwnerView {...rest} /> : <OwnAccess role={role} {...rest} />}
      {role === "owner" && <TransferPanel api={rest.api} unit={unit} included={included} />}
    </div>
  );
}

function OwnAccess({ api, account, target, owner, role, onLeft }: PartProps & { role: SharedRole }) {
  const leave = async (): Promise<void> => {
    try {
      await api.unshare(target, account.id);
    } catch (error) {
      const through = target.kind === "device" && error instanceof ApiError && error.code === "share-unknown";
      throw through ? new Error(texts.access.elsewhere) : error;
    }
    onLeft();
  };
  return (
    <Card title={texts.access.title}>
      <p>{texts.access.owned(accountLabel(owner.name, owner.id), common.role[role])}</p>
      <ConfirmButton
        label={texts.access.leave}
        question={texts.access.leaveQuestion}
        confirmLabel={texts.access.leaveConfirm}
        busyLabel={texts.access.leaving}
        cancelLabel={texts.access.cancel}
        onConfirm={leave}
      />
    </Card>
  );
}

function OwnerView({ api, target, owner, space }: PartProps) {
  const { kind, id } = target;
  const sharing = useMemo(() => new ShareList(api, { kind, id }), [api, kind, id]);
  const [inviting, setInviting] = useState(false);
  useEffect(() => {
    void sharing.refresh();
    const timer = setInterval(() => {
      if (sharing.hasInvitations.value && document.visibilityState === "visible") void sharing.refresh();
    }, REFRESH_MS);
    return () => clearInterval(timer);
  }, [sharing]);

  const shares = sharing.shares.value;
  const error = sharing.error.value;
  const opener = useReturnFocus(inviting);
  const inviteButton = inviting ? null : (
    <button type="button" ref={opener} data-testid="invite" onClick={() => setInviting(true)}>
      {texts.invite.open}
    </button>
  );
  return (
    <Card title={texts.access.title} aside={inviteButton}>
      {kind === "space" && <p class="quiet small">{texts.access.spaceNote}</p>}
      {inviting && <InviteForm sharing={sharing} onClose={() => setInviting(false)} />}
      {error !== "" && (
        <p class="notice bad" role="alert">
          {texts.access.failed(error)}{" "}
          <button type="button" onClick={() => void sharing.refresh()}>
            {texts.access.retry}
          </button>
        </p>
      )}
      {shares === null && error === "" && <p class="quiet">{texts.access.loading}</p>}
      <Undo sharing={sharing} />
      <ul class="people" data-testid="people">
        <li>
          <span class="person">
            {owner.name} <span class="quiet">{shortId(owner.id)} ({texts.access.you})</span>
          </span>
          <span class="chip">{common.role.owner}</span>
        </li>
        {shares?.map((share) => (
          <PersonRow key={share.account.id} share={share} sharing={sharing} />
        ))}
      </ul>
      {shares?.length === 0 && <p class="quiet">{texts.access.none}</p>}
      <OpenLinks sharing={sharing} />
      {space !== undefined && <ThroughSpace api={api} space={space} />}
    </Card>
  );
}

/** The revoked share, with an undo button. */
function Undo({ sharing }: { sharing: ShareList }) {
  const ended = sharing.ended.value;
  const [busy, setBusy] = useState(false);
  const [message, setMessage] = useState<{ text: string; isError: boolean } | null>(null);
  const button = useRef<HTMLButtonElement>(null);
  useEffect(() => {
    if (ended === null) return;
    setMessage(null);
    button.current?.focus(); // The pressed button was removed with its row.
  }, [ended]);
  const undo = async (): Promise<void> => {
    const name = ended?.account.name ?? "";
    setBusy(true);
    try {
      await sharing.undo();
      setMessage({ text: texts.access.restored(name), isError: false });
    } catch (error) {
      setMessage({ text: sentence(error), isError: true });
    } finally {
      setBusy(false);
    }
  };
  return (
    <div role="status">
      {ended !== null && (
        <p class="notice row" data-testid="removed">
          <span>{texts.access.removed(ended.account.name)}</span>
          <button type="button" ref={button} disabled={busy} data-testid="undo" onClick={() => void undo()}>
            {busy ? texts.access.undoing : texts.access.undo}
          </button>
        </p>
      )}
      {ended !== null && sharing.pendingRevocation.value !== "" && <p class="notice warn">{sharing.pendingRevocation.value}</p>}
      {message !== null && <p class={message.isError ? "field-error" : "field-note"}>{message.text}</p>}
    </div>
  );
}

function PersonRow({ share, sharing }: { share: Share; sharing: ShareList }) {
  const { name } = share.account;
  const [changing, setChanging] = useState(false);
  const [busy, setBusy] = useState(false);
  const [message, setMessage] = useState({ text: "", error: false });
  const opener = useReturnFocus(changing);
  const remove = async (): Promise<void> => {
    setBusy(true);
    try {
      await sharing.revoke(share); // This removes the row.
    } catch (error) {
      setMessage({ text: sentence(error), error: true });
      setBusy(false);
    }
  };
  return (
    <li data-testid="person" data-name={name}>
      <span class="person">
        {name}
        <span class="quiet small">
          {shortId(share.account.id)} · {format.until(share.expires_at)} · {texts.access.since(share.created_by, share.created_at)}
        </span>
      </span>
      <span class={`chip role-${share.role}`} title={texts.roleExplained[share.role]}>
        {common.role[share.role]}
      </span>
      <span class="row">
        <button
          type="button"
          class="plain"
          ref={opener}
          aria-label={texts.access.changeOf(name)}
          aria-expanded={changing}
          onClick={() => setChanging(!changing)}
        >
          {texts.access.change}
        </button>
        <button
          type="button"
          class="plain"
          data-testid="remove"
          aria-label={texts.access.removeOf(name)}
          disabled={busy}
          onClick={() => void remove()}
        >
          {busy ? texts.access.removing : texts.access.remove}
        </button>
      </span>
      {changing && (
        <ChangeForm
          share={share}
          sharing={sharing}
          onDone={(text) => {
            setChanging(false);
            setMessage({ text, error: false });
          }}
        />
      )}
      <p class={message.error ? "field-error" : "field-note"} role="status" hidden={message.text === ""}>
        {message.text}
      </p>
    </li>
  );
}

interface ChangeFormProps {
  share: Share;
  sharing: ShareList;
  /** `text`: the result message; empty without a change. */
  onDone: (text: string) => void;
}

function ChangeForm({ share, sharing, onDone }: ChangeFormProps) {
  const [role, setRole] = useState(share.role);
  const [duration, setDuration] = useState(UNCHANGED);
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  const save = async (): Promise<void> => {
    const forS = seconds(duration, secondsLeft(share.expires_at));
    if (forS === undefined) {
      setError(common.duration.past);
      return;
    }
    setBusy(true);
    setError("");
    try {
      const { account, role: now, expires_at: until } = await sharing.share(share.account.name, role, forS);
      onDone(texts.access.changed(account.name, common.role[now], format.until(until)));
    } catch (error) {
      setError(sentence(error));
      setBusy(false);
    }
  };
  return (
    <InlineForm
      label={texts.access.changeOf(share.account.name)}
      submitLabel={texts.access.save}
      busyLabel={texts.access.saving}
      busy={busy}
      error={error}
      onSubmit={save}
      onClose={() => onDone("")}
    >
      <div class="field">
        <span class="label">{texts.invite.role}</span>
        <Choice label={texts.invite.role} value={role} options={SHARED_ROLES} onChange={setRole} />
      </div>
      <DurationPicker
        id={`lasts-${share.account.id}`}
        label={texts.invite.duration}
        value={duration}
        choices={DURATIONS}
        onChange={setDuration}
      />
    </InlineForm>
  );
}

function OpenLinks({ sharing }: { sharing: ShareList }) {
  const invitations = sharing.invitations.value;
  if (invitations.length === 0) return null;
  return (
    <>
      <h3>{texts.access.links}</h3>
      <ul class="people" data-testid="open-links">
        {invitations.map((each) => (
          <OpenLink key={each.id} invitation={each} sharing={sharing} />
        ))}
      </ul>
    </>
  );
}

function OpenLink({ invitation, sharing }: { invitation: Invitation; sharing: ShareList }) {
  const { role, uses, share_s: shareS } = invitation;
  const terms = [texts.access.uses(uses), texts.access.lasts(shareS)];
  return (
    <li>
      <span class="person">
        {texts.access.linkFor[role]}
        <span class="quiet small">{[...terms, format.until(invitation.expires_at)].join(" · ")}</span>
      </span>
      <ConfirmButton
        label={texts.access.withdraw}
        description={`${texts.access.withdraw}: ${texts.access.linkFor[role]}`}
        question={texts.access.withdrawQuestion}
        confirmLabel={texts.access.withdrawConfirm}
        busyLabel={texts.access.withdrawing}
        cancelLabel={texts.access.cancel}
        onConfirm={() => sharing.withdraw(invitation)}
      />
    </li>
  );
}

/** Accounts with access to a device through its space. */
function ThroughSpace({ api, space }: { api: Api; space: { id: string; name: string } }) {
  const [shares, setShares] = useState<readonly Share[]>([]);
  const [error, setError] = useState("");
  useEffect(() => {
    let mounted = true;
    api.shares({ kind: "space", id: space.id }).then(
      (found) => mounted && setShares(found),
      (error: unknown) => mounted && setError(sentence(error)),
    );
    return () => {
      mounted = false;
    };
  }, [api, space.id]);
  if (error !== "") return <p class="field-error">{texts.access.failed(error)}</p>;
  if (shares.length === 0) return null;
  return (
    <>
      <h3>{texts.access.inSpace}</h3>
      <p class="quiet small">
        {texts.access.inSpaceNote} <a href={spaceAddress(space.id)}>{space.name}</a>
      </p>
      <ul class="people">
        {shares.map((share) => (
          <li key={share.account.id}>
            <span class="person">
              {share.account.name}
              <span class="quiet small">
                {shortId(share.account.id)} · {format.until(share.expires_at)}
              </span>
            </span>
            <span class={`chip role-${share.role}`}>{common.role[share.role]}</span>
          </li>
        ))}
      </ul>
    </>
  );
}
