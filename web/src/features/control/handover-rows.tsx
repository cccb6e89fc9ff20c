/** Control bar rows: request control, respond to a request, take over. They extend the bar and do not cover other content. */
import type { DeviceStore } from "../devices/model";
import { useComputed } from "@preact/signals";
import { useEffect, useId, useRef, useState } from "preact/hooks";
import type { ControlRequestState } from "./model/control-request";
import { accountLabel } from "../../shared/lib/account-label";
import { clock } from "../../shared/lib/clock";
import type { Control } from "./model/lease";
import { texts } from "./texts";

/** Remaining seconds, hidden from screen readers, which would announce every second. */
function RemainingTime({ until, format }: { until: number; format: (s: number) => string }) {
  const text = useComputed(() => format(Math.max(0, Math.ceil((until - clock.value) / 1000))));
  return (
    <span class="remaining" aria-hidden="true">
      {text}
    </span>
  );
}

export function RequestControlButton({ control }: { control: Control }) {
  const { kind } = control.outgoingRequest.state.value;
  if (kind === "open") {
    return (
      <button type="button" data-testid="withdraw-request" onClick={() => void control.outgoingRequest.withdraw()}>
        {texts.handover.withdraw}
      </button>
    );
  }
  return (
    <button
      type="button"
      class="primary"
      data-testid="request-control"
      disabled={kind === "sending"}
      onClick={() => void control.outgoingRequest.send()}
    >
      {kind === "sending" ? texts.handover.requesting : texts.handover.request}
    </button>
  );
}

/** The outcome of the control request. */
export function PendingRequest({ control }: { control: Control }) {
  const state = control.outgoingRequest.state.value;
  return (
    <div role="status" class={state.kind === "none" || state.kind === "sending" ? undefined : "bar-row"} data-testid="control-request">
      {state.kind === "open" && (
        <>
          <span>
            {texts.handover.requested(state.holder || texts.handover.operator)} {!state.published && texts.handover.notPublished}
          </span>
          <RemainingTime until={state.until} format={texts.handover.remainingToRespond} />
        </>
      )}
      {(state.kind === "ended" || state.kind === "failed") && (
        <Message text={outcomeText(state)} control={control} isError={state.kind === "failed"} />
      )}
    </div>
  );
}

function outcomeText(state: Extract<ControlRequestState, { kind: "ended" | "failed" }>): string {
  if (state.kind === "failed") return texts.handover.failed(state.reason);
  return texts.handover.outcome[state.outcome](state.holder || texts.handover.operator);
}

function Message({ text, control, isError = false }: { text: string; control: Control; isError?: boolean }) {
  return (
    <>
      <span class={isError ? "bad-text" : undefined}>{text}</span>
      <button type="button" class="plain" onClick={() => control.dismiss()}>
        {texts.control.dismiss}
      </button>
    </>
  );
}

/** The requester, the remaining time and both responses. Does not move the focus, because the operator is steering. */
export function AnswerRequest({ control }: { control: Control }) {
  const request = control.incomingRequest.value;
  const response = control.response.value;
  const sending = response.kind === "sending";
  // The requester, if the request ended without a response: withdrawn or expired.
  const [withdrawnBy, setWithdrawnBy] = useState("");
  const lastRequester = useRef<string | null>(null);
  const held = control.state.value.kind === "held";
  useEffect(() => {
    if (request !== null) {
      lastRequester.current = request.by;
      setWithdrawnBy("");
    } else {
      if (lastRequester.current !== null && held && response.kind === "none") setWithdrawnBy(lastRequester.current);
      lastRequester.current = null;
    }
  }, [request?.id]);

  const requester = request === null ? "" : accountLabel(request.by, request.account);
  const message = response.kind === "kept" ? texts.handover.declined(response.from) : "";
  return (
    <>
      <div role="alert" class={request === null ? undefined : "bar-row incoming-request"} data-testid="incoming-request">
        {request !== null && <strong>{texts.handover.requests(requester)}</strong>}
        {request !== null && <span class="quiet small">{texts.handover.effect}</span>}
      </div>
      {request !== null && (
        <div class="bar-row" role="group" aria-label={texts.handover.requests(requester)}>
          <button type="button" class="primary" data-testid="accept-request" disabled={sending} onClick={() => void control.respond(true)}>
            {sending && response.accept ? texts.handover.accepting : texts.handover.accept(requester)}
          </button>
          <button type="button" data-testid="refuse-request" disabled={sending} onClick={() => void control.respond(false)}>
            {sending && !response.accept ? texts.handover.declining : texts.handover.decline}
          </button>
          <RemainingTime until={request.until} format={texts.handover.remaining} />
        </div>
      )}
      <div role="status" class={message === "" && response.kind !== "failed" && withdrawnBy === "" ? undefined : "bar-row"} data-testid="request-response">
        {message !== "" && request === null && <Message text={message} control={control} />}
        {response.kind === "failed" && <Message text={texts.handover.failed(response.reason)} control={control} isError />}
        {withdrawnBy !== "" && response.kind === "none" && held && request === null && <span>{texts.handover.withdrawn(withdrawnBy)}</span>}
      </div>
    </>
  );
}

interface TakeOverProps {
  device: DeviceStore;
  control: Control;
  onClose: () => void;
}

/** Takeover interrupts the current operator and cannot be undone, so it requires a reason, which that operator sees. */
export function TakeOverForm({ device, control, onClose }: TakeOverProps) {
  const id = useId();
  const [reason, setReason] = useState("");
  const field = useRef<HTMLInputElement>(null);
  const holder = device.holder.value;
  useEffect(() => field.current?.focus(), []);
  return (
    <form
      class="bar-row"
      onSubmit={(event) => {
        event.preventDefault();
        void control.takeOver(reason.trim()).then(onClose);
      }}
    >
      <label for={id}>{texts.handover.reason(holder === null ? "" : accountLabel(holder.name, holder.account))}</label>
      <input
        id={id}
        ref={field}
        type="text"
        required
        pattern=".*\S.*"
        maxLength={200}
        autocomplete="off"
        value={reason}
        aria-describedby={`${id}-note`}
        data-testid="take-over-reason"
        onInput={(event) => setReason(event.currentTarget.value)}
      />
      <button type="submit" class="danger" data-testid="take-over-now">
        {texts.handover.takeOverNow}
      </button>
      <button type="button" onClick={onClose}>
        {texts.handover.cancel}
      </button>
      <span class="quiet small" id={`${id}-note`}>
        {texts.handover.reasonNote}
      </span>
    </form>
  );
}
