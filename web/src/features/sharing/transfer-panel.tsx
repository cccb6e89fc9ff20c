/** Ownership transfer: creates, lists and withdraws offers. For the owner. */
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import type { Invitation, CreatedInvitation } from "../../shared/api/sharing";
import type { Transferable } from "../../shared/api/transfers";
import { format } from "../../shared/i18n/format";
import { accountLabel } from "../../shared/lib/account-label";
import { texts } from "./texts";
import { AccountNameField, InlineForm } from "../../shared/ui/inline-form";
import { ConfirmButton } from "../../shared/ui/confirm-button";
import { useReturnFocus } from "../../shared/hooks/use-return-focus";
import { DurationPicker, ONE_DAY, seconds } from "../../shared/ui/duration-picker";
import { LinkOnce } from "../../shared/ui/link-once";
import { usePolling } from "../../shared/hooks/use-polling";
import "./sharing.css";

/** An open offer can be accepted at any time, so it is polled at this interval [ms]. */
const REFRESH_MS = 5_000;
const VALID = ["hour", "day", "week", "month"] as const;
const RECIPIENTS = [
  ["name", texts.transfer.toName],
  ["link", texts.transfer.toLink],
] as const;

interface TransferProps {
  api: Api;
  unit: Transferable;
  /** Names of the devices that are included. */
  included: readonly string[];
}

export function TransferPanel({ api, unit, included }: TransferProps) {
  const { value: offers, error, refresh } = usePolling(() => api.transfers.open(unit), REFRESH_MS, [api, unit.kind, unit.id]);
  const [step, setStep] = useState<"closed" | "asking" | CreatedInvitation>("closed");
  const opener = useReturnFocus(step !== "closed");
  const open = step !== "closed" ? null : (
    <button type="button" ref={opener} data-testid="transfer" onClick={() => setStep("asking")}>
      {texts.transfer.open}
    </button>
  );
  return (
    <div data-testid="transfers">
      <Card title={texts.transfer.title} aside={open}>
        {step === "asking" && (
          <OfferForm
            api={api}
            unit={unit}
            included={included}
            onMade={(offer) => {
              setStep(offer);
              refresh();
            }}
            onClose={() => setStep("closed")}
          />
        )}
        {typeof step === "object" && (
          <LinkOnce link={step.link} note={texts.transfer.madeNote(format.until(step.expires_at))} onClose={() => setStep("closed")} />
        )}
        {error !== "" && (
          <p class="notice bad" role="alert">
            {texts.transfer.failed(error)}
          </p>
        )}
        {offers?.length === 0 && step === "closed" && <p class="quiet">{texts.transfer.none}</p>}
        {offers !== null && offers.length > 0 && (
          <ul class="people" data-testid="offers">
            {offers.map((offer) => (
              <OpenOffer key={offer.id} offer={offer} withdraw={() => api.transfers.withdraw(unit, offer.id)} onWithdrawn={refresh} />
            ))}
          </ul>
        )}
      </Card>
    </div>
  );
}

interface OpenOfferProps {
  offer: Invitation;
  withdraw: () => Promise<void>;
  onWithdrawn: () => void;
}

function OpenOffer({ offer: { account, expires_at: until }, withdraw, onWithdrawn }: OpenOfferProps) {
  const name = texts.transfer.offered(account === null ? null : accountLabel(account.name, account.id));
  return (
    <li>
      <span class="person">
        {name}
        <span class="quiet small">{texts.transfer.pending(format.until(until))}</span>
      </span>
      <ConfirmButton
        label={texts.access.withdraw}
        description={`${texts.access.withdraw}: ${name}`}
        question={texts.transfer.withdrawQuestion}
        confirmLabel={texts.access.withdrawConfirm}
        busyLabel={texts.access.withdrawing}
        cancelLabel={texts.access.cancel}
        onConfirm={async () => {
          await withdraw();
          onWithdrawn();
        }}
      />
    </li>
  );
}

interface OfferFormProps extends TransferProps {
  onMade: (made: CreatedInvitation) => void;
  onClose: () => void;
}

/** The input stays until the offer succeeds. */
function OfferForm({ api, unit, included, onMade, onClose }: OfferFormProps) {
  const [recipient, setRecipient] = useState<"name" | "link">("name");
  const [name, setName] = useState("");
  const [valid, setValid] = useState(ONE_DAY);
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  const form = useRef<HTMLFormElement>(null);
  useEffect(() => form.current?.querySelector("input")?.focus(), []);
  const send = async (): Promise<void> => {
    setError("");
    setBusy(true);
    try {
      onMade(await api.transfers.offer(unit, recipient === "name" ? name.trim() : null, seconds(valid) ?? 0));
    } catch (error) {
      setError(sentence(error));
      setBusy(false);
    }
  };
  const { todo, doing, title } = texts.transfer;
  const formProps = { label: title, submitLabel: todo, busyLabel: doing, busy, error, form, messageId: "transfer-answer", submitTestId: "transfer-send" };
  return (
    <InlineForm {...formProps} onSubmit={send} onClose={onClose}>
      <ul class="terms" data-testid="transfer-terms">
        <li>{texts.transfer.included[unit.kind](included)}</li>
        {texts.transfer.terms.map((line) => (
          <li key={line}>{line}</li>
        ))}
      </ul>
      <Choice label={texts.transfer.to} value={recipient} options={RECIPIENTS} onChange={setRecipient} />
      {recipient === "name" && (
        <AccountNameField id="transfer-name" messageId="transfer-answer" value={name} invalid={error !== ""} onInput={setName} />
      )}
      <DurationPicker id="transfer-valid" label={texts.transfer.valid} value={valid} choices={VALID} onChange={setValid} />
    </InlineForm>
  );
}
