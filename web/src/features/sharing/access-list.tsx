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
import { texts } from "./texts";
import { InlineForm } from "../../shared/ui/inline-form";
import { ConfirmButton } from "../../shared/ui/confirm-button";
import { useReturnFocus } from "../../shared/hooks/use-return-focus";
import { InviteForm, MAY } from "./invite-form";
import { UNCHANGED, DurationPicker, seconds } from "../../shared/ui/duration-picker";
import { spaceAddress } from "../../shared/routing/routes";
import { TransferPanel } from "./transfer-panel";
import "./sharing.css";

/** An open invitation can be redeemed at any time, so the list is polled at this interval [ms]. */
const LOOK_AGAIN_MS = 5_000;
const LASTS = ["keep", "never", "hour", "workday", "day", "week", "month", "date"] as const;

interface AccessProps {
  api: Api;
  account: Account;
  target: Target;
  /** What is handed over where it is, and the names of all that goes with it. */
  whole: Transferable;
  goes: readonly string[];
  owner: Person;
  role: Role;
  /** Of a device: the space through which others have access too. */
  space?: { id: string; name: string };
  /** One's own part was given up. */
  onLeft: () => void;
}

type PartProps = Omit<AccessProps, "goes" | "role" | "whole">;

const ID = "access";

/** Scrolls to the access list and focuses it. A link cannot do this, because the fragment holds the route. */
export function goToAccess(): void {
  const card = document.getElementById(ID);
  card?.scrollIntoView({ block: "start" });
  card?.querySelector<HTMLElement>("button, input")?.focus({ preventScroll: true });
}

/** The access list of a device or space, with the owner's controls. */
export function AccessList({ role, whole, goes, ...rest }: AccessProps) {
  return (
    <div id={ID} class="access" data-testid="access">
      {role === "owner" ? <OwnersAccess {...rest} /> : <OwnPart role={role} {...rest} />}
      {role === "owner" && <TransferPanel api={rest.api} of={whole} goes={goes} />}
    </div>
  );
}

function OwnPart({ api, account, target, owner, role, onLeft }: PartProps & { role: SharedRole }) {
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
      <p>{texts.access.owned(owner.name, common.role[role])}</p>
      <ConfirmButton
        label={texts.access.leave}
        question={texts.access.leaveSure}
        confirmLabel={texts.access.leaveYes}
        busyLabel={texts.access.leaving}
        cancelLabel={texts.access.keep}
        onConfirm={leave}
      />
    </Card>
  );
}

function OwnersAccess({ api, target, owner, space }: PartProps) {
  const { kind, id } = target;
  const sharing = useMemo(() => new ShareList(api, { kind, id }), [api, kind, id]);
  const [inviting, setInviting] = useState(false);
  useEffect(() => {
    void sharing.refresh();
    const timer = setInterval(() => {
      if (sharing.waits.value && document.visibilityState === "visible") void sharing.refresh();
    }, LOOK_AGAIN_MS);
    return () => clearInterval(timer);
  }, [sharing]);

  const shares = sharing.shares.value;
  const trouble = sharing.trouble.value;
  const opener = useReturnFocus(inviting);
  const open = inviting ? null : (
    <button type="button" ref={opener} data-testid="invite" onClick={() => setInviting(true)}>
      {texts.invite.open}
    </button>
  );
  return (
    <Card title={texts.access.title} aside={open}>
      {kind === "space" && <p class="quiet small">{texts.access.spaceNote}</p>}
      {inviting && <InviteForm sharing={sharing} onClose={() => setInviting(false)} />}
      {trouble !== "" && (
        <p class="notice bad" role="alert">
          {texts.access.failed(trouble)}{" "}
          <button type="button" onClick={() => void sharing.refresh()}>
            {texts.access.again}
          </button>
        </p>
      )}
      {shares === null && trouble === "" && <p class="quiet">{texts.access.loading}</p>}
      <Undo sharing={sharing} />
      <ul class="people" data-testid="people">
        <li>
          <span class="person">
            {owner.name} <span class="quiet">({texts.access.you})</span>
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

/** What was taken away last, and the way back. */
function Undo({ sharing }: { sharing: ShareList }) {
  const ended = sharing.ended.value;
  const [busy, setBusy] = useState(false);
  const [said, setSaid] = useState<{ text: string; wrong: boolean } | null>(null);
  const button = useRef<HTMLButtonElement>(null);
  useEffect(() => {
    if (ended === null) return;
    setSaid(null);
    button.current?.focus(); // The button that was pressed has gone with its line.
  }, [ended]);
  const undo = async (): Promise<void> => {
    const name = ended?.account.name ?? "";
    setBusy(true);
    try {
      await sharing.undo();
      setSaid({ text: texts.access.restored(name), wrong: false });
    } catch (error) {
      setSaid({ text: sentence(error), wrong: true });
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
      {ended !== null && sharing.rest.value !== "" && <p class="notice warn">{sharing.rest.value}</p>}
      {said !== null && <p class={said.wrong ? "field-error" : "field-note"}>{said.text}</p>}
    </div>
  );
}

function PersonRow({ share, sharing }: { share: Share; sharing: ShareList }) {
  const { name } = share.account;
  const [changing, setChanging] = useState(false);
  const [busy, setBusy] = useState(false);
  const [said, setSaid] = useState({ text: "", wrong: false });
  const opener = useReturnFocus(changing);
  const remove = async (): Promise<void> => {
    setBusy(true);
    try {
      await sharing.end(share); // This row goes with it.
    } catch (error) {
      setSaid({ text: sentence(error), wrong: true });
      setBusy(false);
    }
  };
  return (
    <li data-testid="person" data-name={name}>
      <span class="person">
        {name}
        <span class="quiet small">
          {format.until(share.expires_at)} · {texts.access.since(share.created_by, share.created_at)}
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
            setSaid({ text, wrong: false });
          }}
        />
      )}
      <p class={said.wrong ? "field-error" : "field-note"} role="status" hidden={said.text === ""}>
        {said.text}
      </p>
    </li>
  );
}

interface ChangeFormProps {
  share: Share;
  sharing: ShareList;
  /** With what there is to say; empty: nothing was changed. */
  onDone: (text: string) => void;
}

function ChangeForm({ share, sharing, onDone }: ChangeFormProps) {
  const [role, setRole] = useState(share.role);
  const [lasts, setLasts] = useState(UNCHANGED);
  const [busy, setBusy] = useState(false);
  const [wrong, setWrong] = useState("");
  const save = async (): Promise<void> => {
    const forS = seconds(lasts, secondsLeft(share.expires_at));
    if (forS === undefined) {
      setWrong(common.duration.past);
      return;
    }
    setBusy(true);
    setWrong("");
    try {
      const { account, role: now, expires_at: until } = await sharing.put(share.account.name, role, forS);
      onDone(texts.access.changed(account.name, common.role[now], format.until(until)));
    } catch (error) {
      setWrong(sentence(error));
      setBusy(false);
    }
  };
  return (
    <InlineForm
      label={texts.access.changeOf(share.account.name)}
      submitLabel={texts.access.save}
      busyLabel={texts.access.saving}
      busy={busy}
      error={wrong}
      onSubmit={save}
      onClose={() => onDone("")}
    >
      <div class="field">
        <span class="label">{texts.invite.role}</span>
        <Choice label={texts.invite.role} value={role} options={MAY} onChange={setRole} />
      </div>
      <DurationPicker
        id={`lasts-${share.account.id}`}
        label={texts.invite.lasts}
        value={lasts}
        choices={LASTS}
        onChange={setLasts}
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
        question={texts.access.withdrawSure}
        confirmLabel={texts.access.withdrawYes}
        busyLabel={texts.access.withdrawing}
        cancelLabel={texts.access.keep}
        onConfirm={() => sharing.withdraw(invitation)}
      />
    </li>
  );
}

/** Accounts with access to a device through its space. */
function ThroughSpace({ api, space }: { api: Api; space: { id: string; name: string } }) {
  const [shares, setShares] = useState<readonly Share[]>([]);
  const [wrong, setWrong] = useState("");
  useEffect(() => {
    let wanted = true;
    api.shares({ kind: "space", id: space.id }).then(
      (found) => wanted && setShares(found),
      (error: unknown) => wanted && setWrong(sentence(error)),
    );
    return () => {
      wanted = false;
    };
  }, [api, space.id]);
  if (wrong !== "") return <p class="field-error">{texts.access.failed(wrong)}</p>;
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
              <span class="quiet small">{format.until(share.expires_at)}</span>
            </span>
            <span class={`chip role-${share.role}`}>{common.role[share.role]}</span>
          </li>
        ))}
      </ul>
    </>
  );
}
