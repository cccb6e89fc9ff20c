import type { DeviceStore } from "../devices/model";
import { useEffect, useId, useState } from "preact/hooks";
import { accountLabel } from "../../shared/lib/account-label";
import type { DeviceSession } from "./model/device-session";
import type { Control } from "./model/lease";
import { availability, ownAction, reportedEnd } from "./model/status";
import type { Watchers } from "./model/watchers";
import { texts } from "./texts";
import "./control-bar.css";
import { useReturnFocus } from "../../shared/hooks/use-return-focus";
import { AnswerRequest, RequestControlButton, PendingRequest, TakeOverForm } from "./handover-rows";
import { WatcherNames, WatchersButton } from "./watcher-list";

interface ControlBarProps {
  session: DeviceSession;
  /** Other viewers, if tracked. */
  watchers?: Watchers;
}

/** Always visible: the lease holder, take, request and release control, other viewers, and Stop. */
export function ControlBar({ session, watchers }: ControlBarProps) {
  const { device, control, stop } = session;
  const names = useId();
  const [open, setOpen] = useState(false);
  const [takingOver, setTakingOver] = useState(false);
  const opener = useReturnFocus(takingOver);
  const isViewer = device.info.value.role === "viewer";
  useAccountIds(device);
  return (
    <div class="control-bar" role="region" aria-label={texts.control.title}>
      <ControlState session={session} />
      <RecordingChip device={device} />
      {watchers !== undefined && <WatchersButton watchers={watchers} open={open} names={names} onToggle={() => setOpen(!open)} />}
      <LeaseButton device={device} control={control} />
      {!takingOver && mayTakeOver(device, control) && (
        <button type="button" ref={opener} data-testid="take-over" onClick={() => setTakingOver(true)}>
          {texts.handover.takeOver}
        </button>
      )}
      <button
        type="button"
        class="stop"
        data-testid="stop"
        disabled={isViewer}
        title={isViewer ? texts.control.viewer : texts.stop.keyExplained}
        aria-keyshortcuts="Escape"
        onClick={() => {
          control.onStop();
          stop.press();
        }}
      >
        {texts.stop.press} <kbd>{texts.stop.key}</kbd>
      </button>
      {takingOver && mayTakeOver(device, control) && (
        <TakeOverForm device={device} control={control} onClose={() => setTakingOver(false)} />
      )}
      <PendingRequest control={control} />
      <AnswerRequest control={control} />
      {watchers !== undefined && open && <WatcherNames watchers={watchers} id={names} />}
    </div>
  );
}

/** What is being recorded now; nothing without a recording or while the device's state is not current. */
function RecordingChip({ device }: { device: DeviceStore }) {
  const state = device.state.value;
  const cameras = state?.recorded_cameras ?? [];
  if (!device.live.value || state === null || (!state.recording && cameras.length === 0)) return null;
  const chip = { class: "chip control-recording", "data-testid": "recording" };
  return cameras.length > 0 ? (
    <span {...chip} data-cameras={cameras.join(" ")} title={texts.control.camerasExplained(cameras.join(", "))}>
      {texts.control.recordingCameras}
    </span>
  ) : (
    <span {...chip} title={texts.control.recordingExplained}>
      {texts.control.recording}
    </span>
  );
}

/** Asks the cloud who has and who requests control, because the device reports only names. */
function useAccountIds(device: DeviceStore): void {
  const holder = device.holder.value;
  const request = device.request.value;
  // The lease of a single action is only in the cloud.
  const action = device.state.value?.action?.id;
  const anonymous = holder === null ? action !== undefined : !holder.mine && holder.account === "";
  const unknown = anonymous || request?.account === "";
  useEffect(() => {
    if (unknown) void device.refreshLease();
  }, [device, unknown, device.state.value?.epoch, request?.id, action]);
}

/** Whether another operator has control, so that this page must request it. */
function heldByOther(device: DeviceStore, control: Control): boolean {
  const holder = device.holder.value;
  const { kind } = control.state.value;
  return holder !== null && !holder.mine && kind !== "held" && kind !== "taking";
}

function mayTakeOver(device: DeviceStore, control: Control): boolean {
  return device.info.value.role === "owner" && heldByOther(device, control);
}

/** Take, request or release control, depending on the state. */
function LeaseButton({ device, control }: { device: DeviceStore; control: Control }) {
  const state = control.state.value;
  const described = device.description.value !== null;
  const isViewer = device.info.value.role === "viewer";
  if (state.kind === "held") {
    return (
      <button type="button" data-testid="release-control" onClick={() => void control.release()}>
        {texts.control.release}
      </button>
    );
  }
  const request = control.outgoingRequest.state.value.kind;
  // After a failed request the lease may have ended before the robot reports it: offer to take control.
  if (heldByOther(device, control) && !isViewer && request !== "failed") return <RequestControlButton control={control} />;
  const resumable = device.holder.value?.mine === true;
  return (
    <button
      type="button"
      class="primary"
      data-testid="take-control"
      disabled={state.kind === "taking" || !described || isViewer}
      title={isViewer ? texts.control.viewer : described ? undefined : texts.control.needsDescription}
      onClick={() => void control.take()}
    >
      {state.kind === "taking" ? texts.control.taking : resumable ? texts.control.resume : texts.control.take}
    </button>
  );
}

type Shown = "mine" | "running" | "other" | "free" | "lost" | "refused" | "taking" | "handed";

function ControlState({ session }: { session: DeviceSession }) {
  const [shown, text] = describe(session);
  return (
    <p class={`control-state control-${shown}`} data-testid="control-state" data-state={shown} role="status">
      <span class="dot" aria-hidden="true" />
      {text}
    </p>
  );
}

function describe(session: DeviceSession): [Shown, string] {
  const { device, control } = session;
  const state = control.state.value;
  const holder = device.holder.value;
  const lease = device.state.value?.lease ?? null;
  const reason = lease !== null && lease.holder === holder?.name ? (lease.reason ?? "") : "";
  const name = holder === null ? "" : accountLabel(holder.name, holder.account);
  const action = ownAction(session);
  if (action !== null && state.kind !== "taking") {
    const text = action.elsewhere ? texts.control.runningElsewhere : texts.control.running;
    return [state.kind === "held" ? "mine" : "running", text(action.name)];
  }
  switch (state.kind) {
    case "taking":
      return ["taking", texts.control.taking];
    case "held":
      return ["mine", state.confirmed ? texts.control.mine : texts.control.unconfirmed];
    case "lost": {
      // Until the page knows the next lease, the holder is this page's own.
      const next = holder !== null && holder.epoch > state.epoch ? name : "";
      return ["lost", texts.control.lost(reason === "" ? lostReason(device, state.epoch, next, state.reason) : texts.control.tookOver(name, reason))];
    }
    case "refused":
      return ["refused", texts.control.refused(state.reason)];
    case "handed":
      return ["handed", texts.control.handed(state.to)];
    case "none":
      if (holder === null) return ["free", texts.control.free[availability(device)]];
      if (holder.mine) return ["other", texts.control.elsewhere];
      return ["other", reason === "" ? texts.control.other(name) : texts.control.tookOver(name, reason)];
  }
}

/** Why control was lost: the robot's own report if it has arrived, otherwise the page's. */
function lostReason(device: DeviceStore, epoch: number, holder: string, otherwise: string): string {
  const reported = reportedEnd(device, epoch);
  const stop = device.state.value?.stop?.caller;
  // The state names a verified author, once a signed Stop has followed.
  if (stop !== undefined && (reported === null || reported.code === "stopped")) return texts.control.stopped(stop);
  if (reported !== null) return reported.code === "fault" ? texts.control.fault(reported.message) : reported.message;
  return holder === "" ? otherwise : texts.control.taken(holder);
}
