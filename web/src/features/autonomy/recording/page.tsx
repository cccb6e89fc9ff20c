/** The recording of one session: robot, values, plots, images and episodes at any time of it. */
import { useEffect, useState } from "preact/hooks";
import type { Account } from "../../../shared/api/types";
import type { Api } from "../../../shared/api/client";
import { storedFile } from "../../../shared/api/recordings";
import { common } from "../../../shared/i18n/common";
import { format } from "../../../shared/i18n/format";
import { autonomyAddressOf } from "../../../shared/routing/routes";
import { ConfirmButton } from "../../../shared/ui/confirm-button";
import { LoadError } from "../../../shared/ui/load-error";
import { DevicePageFrame } from "../../control";
import type { DeviceStore, Fleet } from "../../devices/model";
import { expectsMore, Replay, SegmentLoader } from "../model/recording";
import { CompareCard } from "./comparison/compare-card";
import { type Compared, useComparison } from "./comparison/use-comparison";
import { ReplayView } from "./replay-view";
import { texts } from "./texts";
import "./sessions.css";

/** A session that is still recorded has a new part each minute. */
const REFRESH_MS = 10_000;
/** Gaps that are listed at once, and at most. */
const OPEN_GAPS = 3;
const MAX_GAPS = 50;

interface SessionPageProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  device: string;
  epoch: string;
  /** The session to compare with, as `selectionText` writes it, or "". */
  other: string;
}

export function SessionPage({ device, epoch, other, ...rest }: SessionPageProps) {
  return (
    <DevicePageFrame {...rest} id={device} page="session">
      {({ device: store }) => <RecordedSession api={rest.api} fleet={rest.fleet} device={store} epoch={Number(epoch)} other={other} />}
    </DevicePageFrame>
  );
}

interface RecordedSessionProps {
  api: Api;
  fleet: Fleet;
  device: DeviceStore;
  epoch: number;
  other: string;
}

function RecordedSession({ api, fleet, device, epoch, other }: RecordedSessionProps) {
  const replay = useReplay(api, device.id, epoch);
  const compared = useComparison(api, fleet, device, replay, other);
  if (!Number.isSafeInteger(epoch)) return <p class="notice warn">{texts.withoutNumber}</p>;
  const session = replay?.session.value ?? null;
  const error = replay?.error.value ?? "";
  return (
    <div class="session-page" data-testid="recorded-session">
      <p class="row session-line">
        <a href={autonomyAddressOf(device.id)}>← {texts.back}</a>
        {session !== null && (
          <span class="quiet">
            {texts.by(session.holder, session.started_at === null ? format.unknown : format.dateTime(session.started_at))}, {session.task ?? texts.manual}
          </span>
        )}
      </p>
      {replay !== null && <LoadError reason={error} retry={() => void replay.retry()} />}
      {session === null && error === "" && (
        <p class="quiet" role="status">
          {common.loading}
        </p>
      )}
      {replay !== null && session !== null && <Content api={api} fleet={fleet} device={device} replay={replay} compared={compared} />}
    </div>
  );
}

/** The replay of a session; null before the page is mounted. */
function useReplay(api: Api, device: string, epoch: number): Replay | null {
  const [replay, setReplay] = useState<Replay | null>(null);
  useEffect(() => {
    if (!Number.isSafeInteger(epoch)) return undefined;
    const loader = new SegmentLoader();
    const created = new Replay({
      session: () => api.recordings.of(device, epoch),
      file: storedFile,
      segment: (...call) => loader.load(...call),
      save: (episodes, etag) => api.recordings.saveEpisodes(device, epoch, episodes, etag),
    });
    setReplay(created);
    void created.refresh();
    const timer = setInterval(() => {
      if (document.visibilityState === "visible" && expectsMore(created.session.peek())) void created.refresh();
    }, REFRESH_MS);
    return () => {
      clearInterval(timer);
      created.dispose();
      loader.dispose();
    };
  }, [api, device, epoch]);
  return replay;
}

interface ContentProps {
  api: Api;
  fleet: Fleet;
  device: DeviceStore;
  replay: Replay;
  compared: Compared;
}

function Content({ api, fleet, device, replay, compared }: ContentProps) {
  const session = replay.session.value;
  const recording = session?.recording ?? null;
  if (session === null || recording === null || recording.segments.length === 0) {
    return (
      <div class="notice" data-testid="no-recording">
        <p>{texts.none}</p>
        <p class="quiet">{texts.noneHint}</p>
      </div>
    );
  }
  const { parts } = replay.timeline.value;
  const { role } = device.info.value;
  const remove = async (): Promise<void> => {
    await api.recordings.remove(device.id, session.epoch);
    await replay.refresh();
  };
  return (
    <>
      {!recording.final && <Incomplete replay={replay} />}
      <Gaps replay={replay} />
      <Failures replay={replay} />
      {parts.length > 0 && (
        <ReplayView api={api} device={device} replay={replay} cameras={recording.cameras} editable={role !== "viewer"} comparison={compared.comparison}>
          <CompareCard api={api} fleet={fleet} device={device} replay={replay} {...compared} />
        </ReplayView>
      )}
      {role === "owner" && (
        <div class="session-delete">
          <ConfirmButton
            label={texts.remove}
            question={texts.removeQuestion}
            confirmLabel={texts.remove}
            busyLabel={texts.removing}
            cancelLabel={texts.cancel}
            onConfirm={remove}
            data-testid="delete-recording"
          />
        </div>
      )}
    </>
  );
}

/** More may arrive: by itself while the session is recent, later on request. */
function Incomplete({ replay }: { replay: Replay }) {
  const refreshes = expectsMore(replay.session.value);
  return (
    <p class="notice row" data-testid="incomplete-recording">
      <span>{refreshes ? texts.incomplete : texts.mayArrive}</span>
      {!refreshes && (
        <button type="button" onClick={() => void replay.refresh()}>
          {texts.check}
        </button>
      )}
    </p>
  );
}

/** Times without data, each with its cause. */
function Gaps({ replay }: { replay: Replay }) {
  const gaps = replay.gaps.value;
  if (gaps.length === 0) return null;
  return (
    <details class="notice warn" data-testid="recording-gaps" open={gaps.length <= OPEN_GAPS}>
      <summary>{texts.gaps.title(gaps.length)}</summary>
      <ul class="session-gaps">
        {gaps.slice(0, MAX_GAPS).map(({ start_s, end_s, cause }) => (
          <li key={start_s} data-cause={cause}>
            <button type="button" class="plain" onClick={() => replay.seek(start_s)}>
              {texts.episodes.range(start_s, end_s)}
            </button>
            {texts.gaps.cause[cause]}
          </li>
        ))}
      </ul>
      {gaps.length > MAX_GAPS && <p>{texts.gaps.more(gaps.length - MAX_GAPS)}</p>}
    </details>
  );
}

/** Parts that could not be loaded, and files that end early. */
function Failures({ replay }: { replay: Replay }) {
  const numbers = replay.timeline.value.parts.map(({ info }) => info.segment);
  const reasons = new Map(replay.timeline.value.parts.flatMap(({ info, overview }) => (typeof overview === "string" ? [[info.segment, overview]] : [])));
  for (const number of numbers) {
    const reason = replay.segments.error(number);
    if (reason !== "") reasons.set(number, reason);
  }
  const [first] = reasons.values();
  const cut = numbers.filter((number) => replay.segments.get(number)?.extent === "truncated");
  return (
    <>
      {first !== undefined && (
        <p class="notice bad row" role="alert" data-testid="failed-segments">
          <span>{texts.failed([...reasons.keys()].sort((one, other) => one - other), first)}</span>
          <button type="button" onClick={() => void replay.retry()}>
            {common.tryAgain}
          </button>
        </p>
      )}
      {cut.map((number) => (
        <p key={number} class="notice warn" data-testid="truncated-segment">
          {texts.truncated(number)}
        </p>
      ))}
    </>
  );
}
