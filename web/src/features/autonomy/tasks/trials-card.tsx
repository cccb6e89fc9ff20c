/** The trials of a task, newest first, with filters. */
import { useEffect, useMemo, useState } from "preact/hooks";
import type { Api } from "../../../shared/api/client";
import type { Trial, TrialState } from "../../../shared/api/tasks";
import { common } from "../../../shared/i18n/common";
import { format } from "../../../shared/i18n/format";
import { deviceAddress, sessionAddress } from "../../../shared/routing/routes";
import { Card } from "../../../shared/ui/card";
import { Choice } from "../../../shared/ui/choice";
import { durationText, TrialHistory } from "../model";
import { texts } from "./texts";

const EVERY_MS = 3_000;
type StateFilter = keyof typeof texts.filters;

interface TrialsCardProps {
  api: Api;
  robotType: string;
  name: string;
  /** Device id → label of the robots of this type. */
  labels: ReadonlyMap<string, string>;
}

export function TrialsCard({ api, robotType, name, labels }: TrialsCardProps) {
  const [state, setState] = useState<StateFilter>("");
  const [device, setDevice] = useState("");
  const history = useMemo(() => new TrialHistory(api, robotType, name, { device, state }), [api, robotType, name, device, state]);
  useEffect(() => {
    void history.refresh();
    const timer = setInterval(() => {
      if (document.visibilityState === "visible") void history.refresh();
    }, EVERY_MS);
    return () => clearInterval(timer);
  }, [history]);
  const trials = history.trials.value;
  const error = history.error.value;
  const filtered = state !== "" || device !== "";
  return (
    <Card title={texts.trials} data-testid="trials">
      <div class="trial-filters">
        <Choice label={texts.filter} value={state} onChange={setState} options={Object.entries(texts.filters) as [StateFilter, string][]} />
        {labels.size > 1 && (
          <select aria-label={texts.robot} value={device} onChange={({ currentTarget }) => setDevice(currentTarget.value)}>
            <option value="">{texts.allRobots}</option>
            {[...labels].map(([id, label]) => (
              <option key={id} value={id}>
                {label}
              </option>
            ))}
          </select>
        )}
      </div>
      {error !== "" && (
        <p class="notice bad" role="alert">
          {common.loadFailed(error)}
        </p>
      )}
      {trials === null && error === "" && <p class="quiet">{common.loading}</p>}
      {trials?.length === 0 && <p class="quiet">{filtered ? texts.noMatching : texts.noTrials}</p>}
      {trials !== null && trials.length > 0 && (
        <ol class="trial-list">
          {trials.map((trial) => (
            <TrialItem key={trial.action} trial={trial} label={labels.get(trial.device) ?? trial.device} />
          ))}
        </ol>
      )}
      {history.more.value !== null && (
        <p>
          <button type="button" disabled={history.busy.value} data-testid="older-trials" onClick={() => void history.loadOlder()}>
            {texts.older}
          </button>
        </p>
      )}
    </Card>
  );
}

const CHIPS: Readonly<Record<TrialState, string>> = { running: "", success: "reach-online", failed: "bad", unknown: "reach-stale" };

function TrialItem({ trial, label }: { trial: Trial; label: string }) {
  const { action, device, state, cause, detail, epoch, seed, simulated, duration_s: durationS, type_version: version } = trial;
  const facts = [
    seed === null ? texts.noSeed : texts.seedOf(seed),
    ...(durationS === null ? [] : [durationText(durationS)]),
    trial.caller,
    ...(version === null ? [] : [texts.version(version)]),
  ];
  return (
    <li data-testid="trial" data-action={action} data-state={state} data-cause={cause}>
      <span>
        <time dateTime={trial.started_at}>{format.dateTime(trial.started_at)}</time>
        <br />
        <a href={deviceAddress(device)}>{label}</a>
        {simulated !== null && <span class="quiet small"> {simulated ? texts.simulated : texts.real}</span>}
      </span>
      <span>
        <span class={`chip ${CHIPS[state]}`}>{texts.state[state]}</span> {cause !== "" && (texts.cause[cause] ?? cause)}
        {detail !== "" && <span class="quiet small trial-detail">{detail}</span>}
      </span>
      <span class="quiet small">{facts.join(" · ")}</span>
      <span class="trial-links">
        <a href={sessionAddress(device, epoch)}>{texts.session}</a>
        <a href={`/api/v1/actions/${action}`}>{texts.action}</a>
      </span>
    </li>
  );
}
