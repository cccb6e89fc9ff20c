/** Autonomy of one robot: who moved it, over time, by task and in each session. */
import type { Account } from "../../shared/api/types";
import type { Autonomy } from "../../shared/api/autonomy";
import { DevicePageFrame } from "../control";
import type { DeviceStore, Fleet } from "../devices/model";
import { useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { usePolling } from "../../shared/hooks/use-polling";
import { common } from "../../shared/i18n/common";
import { serverNow } from "../../shared/lib/clock";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { durationText, metricsOf, type Span, startOf } from "./model";
import { SessionsCard } from "./sessions-card";
import { Key, ShareBar } from "./share-bar";
import { OverTimeCard } from "./over-time-card";
import { TaskListCard } from "./tasks/task-list-card";
import { TasksCard } from "./tasks-card";
import { texts } from "./texts";
import "./autonomy.css";

/** Sums change slowly, and the server reads all sessions of the span. */
const EVERY_MS = 30_000;
const SESSIONS_EVERY_MS = 10_000;

interface AutonomyPageProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  device: string;
}

export function AutonomyPage({ device, ...rest }: AutonomyPageProps) {
  return (
    <DevicePageFrame {...rest} id={device} page="autonomy">
      {(session) => <DeviceAutonomy api={rest.api} device={session.device} />}
    </DevicePageFrame>
  );
}

function DeviceAutonomy({ api, device }: { api: Api; device: DeviceStore }) {
  const joints = device.description.value?.joints.length;
  if (joints === 0) {
    return (
      <p class="notice" data-testid="no-autonomy">
        {texts.noJoints}
      </p>
    );
  }
  return <RobotAutonomy api={api} device={device} />;
}

function RobotAutonomy({ api, device }: { api: Api; device: DeviceStore }) {
  const [span, setSpan] = useState<Span>("month");
  const { value, error } = usePolling(() => api.autonomy.of(device.id, startOf(span, serverNow())), EVERY_MS, [api, device, span]);
  return (
    <div class="autonomy-page">
      <p class="quiet">{texts.explained}</p>
      <div>
        <Choice label={texts.span} value={span} onChange={setSpan} options={Object.entries(texts.spans) as [Span, string][]} />
      </div>
      {error !== "" && <p class="notice bad">{texts.failed(error)}</p>}
      {value === null ? error === "" && <p class="quiet">{common.loading}</p> : <Evaluation autonomy={value} span={span} />}
      <TaskListCard api={api} robotType={device.info.value.robot_type} />
      <SessionsCard api={api} device={device.id} everyMs={SESSIONS_EVERY_MS} />
    </div>
  );
}

function Evaluation({ autonomy, span }: { autonomy: Autonomy; span: Span }) {
  const moved = autonomy.share.hti !== null;
  return (
    <>
      {!autonomy.complete && <p class="notice warn">{texts.incomplete}</p>}
      <div class="autonomy-columns">
        <SharesCard autonomy={autonomy} />
        {moved && <OverTimeCard days={autonomy.days} span={span} nowMs={serverNow()} />}
      </div>
      {autonomy.sessions > 0 && <TasksCard autonomy={autonomy} />}
    </>
  );
}

/** The shares in all, and the papers' metrics, each with its meaning. */
function SharesCard({ autonomy: { share } }: { autonomy: Autonomy }) {
  const { operator_s: operatorS, machine_s: machineS } = share;
  const metrics = metricsOf(share);
  if (metrics === null) {
    return (
      <Card title={texts.shares}>
        <p data-testid="no-motion">{texts.noMotion}</p>
        <p class="quiet">{texts.noMotionHint}</p>
      </Card>
    );
  }
  const { hti, mti, mtia } = metrics;
  const rows = [
    ["hti", texts.metrics.hti, texts.meaning.hti, hti],
    ["mti", texts.metrics.mti, texts.meaning.mti, mti],
    ["mtia", texts.metrics.mtia, mtia === null ? texts.meaning.mtiaUndefined : texts.meaning.mtia, mtia ?? texts.undefinedRatio],
  ] as const;
  return (
    <Card title={texts.shares}>
      <ShareBar operatorS={operatorS} machineS={machineS} />
      <ul class="share-legend">
        <li>
          <Key source="operator" /> {texts.source(texts.operator, hti, durationText(operatorS))}
        </li>
        <li>
          <Key source="machine" /> {texts.source(texts.machine, mti, durationText(machineS))}
        </li>
      </ul>
      <dl class="metrics">
        {rows.map(([id, name, meaning, value]) => (
          <div key={id} data-testid={`metric-${id}`} data-value={share[id] ?? ""}>
            <dt>{name}</dt>
            <dd>
              <strong>{value}</strong>
              <span class="quiet small">{meaning}</span>
            </dd>
          </div>
        ))}
      </dl>
    </Card>
  );
}
