import type { Account, Space } from "../../shared/api/types";
import type { Fleet } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { ApiError, sentence } from "../../shared/api/http";
import type { FollowedInvitation } from "./model/invitation-link";
import type { Invitation } from "../../shared/api/sharing";
import { common } from "../../shared/i18n/common";
import { accountLabel } from "../../shared/lib/account-label";
import { texts } from "./texts";
import { ConfirmButton } from "../../shared/ui/confirm-button";
import { deviceAddress, deviceListAddress, replaceWith, spaceAddress } from "../../shared/routing/routes";

interface InvitationPageProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  followed: FollowedInvitation;
}

/** Shows an invitation, and accepts or declines it. */
export function InvitationPage(props: InvitationPageProps) {
  const [accepted, setAccepted] = useState<Invitation | null>(null);
  const state = props.followed.state.value;
  return (
    <main class="page invitation" id="content">
      {accepted !== null ? (
        <Accepted invitation={accepted} />
      ) : state.kind === "open" ? (
        <Offer key={state.secret} {...props} secret={state.secret} away={state.away} onAccepted={setAccepted} />
      ) : state.kind === "joined" ? (
        <Joined {...props} />
      ) : (
        <p>
          <a href={deviceListAddress}>{texts.invitation.toDevices}</a>
        </p>
      )}
    </main>
  );
}

interface OfferProps extends InvitationPageProps {
  secret: string;
  away: boolean;
  onAccepted: (invitation: Invitation) => void;
}

function Offer({ api, fleet, account, followed, secret, away, onAccepted }: OfferProps) {
  const [offer, setOffer] = useState<Invitation | null>(null);
  const [ownSpaces, setOwn] = useState<readonly Space[]>([]);
  const [space, setSpace] = useState<string | null>(null);
  const [busy, setBusy] = useState(false);
  const [failure, setFailure] = useState<{ text: string; final: boolean } | null>(null);

  const handleError = (error: unknown): void => {
    const final = error instanceof ApiError && error.code === "invitation-unknown";
    // An account created at the provider has already redeemed it.
    if (final && away) followed.joined();
    else setFailure({ text: sentence(error), final });
  };
  const load = async (): Promise<void> => {
    setFailure(null);
    try {
      const preview = await api.previewInvitation(secret);
      if (preview.kind === "agent") setOwn((await api.spaces()).filter(({ role }) => role === "owner"));
      setOffer(preview);
    } catch (error) {
      handleError(error);
    }
  };
  useEffect(() => void load(), [api, secret]);

  const accept = async (): Promise<void> => {
    setBusy(true);
    setFailure(null);
    try {
      const accepted = await api.redeemInvitation(secret, space);
      await fleet.refresh();
      onAccepted(accepted);
      followed.drop();
    } catch (error) {
      handleError(error);
      setBusy(false);
    }
  };
  const decline = (): void => {
    followed.drop();
    replaceWith(deviceListAddress);
  };

  const isTransfer = offer?.role === "owner";
  const title =
    offer === null
      ? texts.invitation.title
      : isTransfer
        ? texts.invitation.offersOwnership(accountLabel(offer.created_by, offer.created_by_account), offer.label)
        : texts.invitation.offers(accountLabel(offer.created_by, offer.created_by_account), offer.label);
  return (
    <>
      <h1>{title}</h1>
      {offer === null && failure === null && (
        <p class="quiet" role="status">
          {texts.invitation.loading}
        </p>
      )}
      {offer !== null && <Terms offer={offer} />}
      {offer?.kind === "agent" && ownSpaces.length > 1 && (
        <div class="field">
          <label for="into-space">{texts.invitation.space}</label>
          <select id="into-space" value={space ?? ""} onChange={(event) => setSpace(event.currentTarget.value)}>
            {ownSpaces.map(({ id, name }) => (
              <option key={id} value={id}>
                {name}
              </option>
            ))}
          </select>
        </div>
      )}
      <p class="quiet">{texts.invitation.as(accountLabel(account.name, account.id))}</p>
      <div role="alert">{failure !== null && <p class="notice bad">{failure.text}</p>}</div>
      <div class="row">
        {offer !== null && isTransfer && failure?.final !== true && (
          <ConfirmButton
            label={texts.invitation.acceptTransfer}
            question={texts.invitation.transferQuestion(offer.label)}
            confirmLabel={texts.invitation.transferConfirm}
            busyLabel={texts.invitation.accepting}
            cancelLabel={texts.invitation.transferCancel}
            onConfirm={accept}
            data-testid="accept"
          />
        )}
        {offer !== null && !isTransfer && failure?.final !== true && (
          <button type="button" class="primary" data-testid="accept" disabled={busy} onClick={() => void accept()}>
            {busy ? texts.invitation.accepting : texts.invitation.accept}
          </button>
        )}
        {offer === null && failure !== null && !failure.final && (
          <button type="button" onClick={() => void load()}>
            {texts.invitation.retry}
          </button>
        )}
        <button type="button" disabled={busy} onClick={decline}>
          {failure?.final === true ? texts.invitation.toDevices : texts.invitation.notNow}
        </button>
      </div>
    </>
  );
}

function Terms({ offer: { role, kind, share_s: shareS } }: { offer: Invitation }) {
  if (role === "owner") {
    return (
      <ul class="terms" data-testid="terms">
        {[...texts.invitation.transferNotes, texts.invitation.declined].map((line) => (
          <li key={line}>{line}</li>
        ))}
      </ul>
    );
  }
  return (
    <ul class="terms" data-testid="terms">
      <li>{texts.invitation.permissions[role]}</li>
      {texts.invitation.kind[kind] !== "" && <li>{texts.invitation.kind[kind]}</li>}
      <li>{texts.invitation.lasts(shareS)}</li>
    </ul>
  );
}

function Accepted({ invitation: { kind, target, label, role } }: { invitation: Invitation }) {
  const address = kind === "device" ? deviceAddress(target) : kind === "space" ? spaceAddress(target) : deviceListAddress;
  const next = useRef<HTMLAnchorElement>(null);
  useEffect(() => next.current?.focus(), []);
  return (
    <>
      <h1>{role === "owner" ? texts.invitation.transferred(label) : texts.invitation.accepted(label)}</h1>
      <p>
        <a class="elsewhere" ref={next} data-testid="open-it" href={address}>
          {kind === "agent" ? texts.invitation.toDevices : texts.invitation.open(label)}
        </a>
      </p>
    </>
  );
}

/** The page after creating an account with the invitation: everything that is shared with it. */
function Joined({ api, fleet, account }: InvitationPageProps) {
  const [spaces, setSpaces] = useState<readonly Space[] | null>(null);
  const [error, setError] = useState("");
  useEffect(() => {
    api.spaces().then(setSpaces, (error: unknown) => setError(sentence(error)));
  }, [api]);
  const devices = fleet.devices.value;
  const waiting = (spaces === null && error === "") || devices === null;
  const sharedSpaces = spaces?.filter(({ role }) => role !== "owner") ?? [];
  const sharedDevices = [...(devices?.values() ?? [])].map(({ info }) => info.value).filter(({ role }) => role !== "owner");
  const empty = !waiting && error === "" && sharedSpaces.length + sharedDevices.length === 0;
  return (
    <>
      <h1>{texts.invitation.signedInAs(account.name)}</h1>
      <p role="status">
        {waiting ? common.loading : empty ? texts.invitation.joinedNothing : texts.invitation.joined}
      </p>
      {error !== "" && <p class="notice bad">{texts.invitation.spacesFailed(error)}</p>}
      {sharedSpaces.length + sharedDevices.length > 0 && (
        <Card title={texts.invitation.devices}>
          <ul class="people" data-testid="shared-with-me">
            {sharedSpaces.map(({ id, name, role }) => (
              <li key={id}>
                <a class="person" href={spaceAddress(id)}>
                  {name}
                </a>
                <span class={`chip role-${role}`}>{common.role[role]}</span>
              </li>
            ))}
            {sharedDevices.map(({ id, label, role }) => (
              <li key={id}>
                <a class="person" href={deviceAddress(id)}>
                  {label}
                </a>
                <span class={`chip role-${role}`}>{common.role[role]}</span>
              </li>
            ))}
          </ul>
        </Card>
      )}
    </>
  );
}
