/** One task: what it demands, how often robots complete it, and its trials. */
import type { Fleet } from "../../devices/model";
import type { Api } from "../../../shared/api/client";
import type { TaskReport } from "../../../shared/api/tasks";
import { usePolling } from "../../../shared/hooks/use-polling";
import { common } from "../../../shared/i18n/common";
import { movementAddress, tasksAddress } from "../../../shared/routing/routes";
import { Card } from "../../../shared/ui/card";
import { conditionOf } from "../model";
import { BatchesCard, RatesCard } from "./rates-cards";
import { StartCard } from "./start-card";
import { TrialsCard } from "./trials-card";
import { texts } from "./texts";
import "./tasks.css";

const EVERY_MS = 10_000;

interface TaskPageProps {
  api: Api;
  fleet: Fleet;
  robotType: string;
  name: string;
}

export function TaskPage({ api, fleet, robotType, name }: TaskPageProps) {
  const { value, error, refresh } = usePolling(() => api.tasks.get(robotType, name), EVERY_MS, [api, robotType, name]);
  return (
    <main class="page fleet task-page" id="content">
      <a href={tasksAddress(robotType)}>← {texts.back(robotType)}</a>
      <h1>{value?.label ?? name}</h1>
      {error !== "" && (
        <p class="notice bad" role="alert">
          {common.loadFailed(error)}
        </p>
      )}
      {value === null && error === "" && (
        <p class="quiet" role="status">
          {common.loading}
        </p>
      )}
      {value !== null && <Loaded api={api} fleet={fleet} robotType={robotType} task={value} refresh={refresh} />}
    </main>
  );
}

interface LoadedProps {
  api: Api;
  fleet: Fleet;
  robotType: string;
  task: TaskReport;
  refresh: () => void;
}

function Loaded({ api, fleet, robotType, task, refresh }: LoadedProps) {
  const devices = [...(fleet.devices.value?.values() ?? [])].map(({ info }) => info.value).filter((each) => each.robot_type === robotType);
  const labels = new Map(devices.map(({ id, label }) => [id, label]));
  return (
    <>
      <p>{task.description}</p>
      <div class="task-columns">
        <DemandsCard robotType={robotType} task={task} />
        <StartCard api={api} task={task} devices={devices} onStarted={refresh} />
      </div>
      <RatesCard task={task} labels={labels} />
      <TrialsCard api={api} robotType={robotType} name={task.name} labels={labels} />
      {task.batches.length > 0 && <BatchesCard batches={task.batches} />}
    </>
  );
}

function DemandsCard({ robotType, task }: { robotType: string; task: TaskReport }) {
  const parameters = Object.entries(task.parameters);
  return (
    <Card title={texts.condition} aside={<span class="chip">{texts.observed[task.observed]}</span>}>
      <p data-testid="condition">{conditionOf(task)}</p>
      <dl class="facts">
        <dt>{texts.movement}</dt>
        <dd>
          <a href={movementAddress(robotType, task.movement)}>{task.movement}</a>
        </dd>
        <dt>{texts.parameters}</dt>
        <dd>{parameters.length === 0 ? texts.noParameters : parameters.map(([name, value]) => `${name} = ${String(value)}`).join(", ")}</dd>
        <dt>{texts.timeLimit}</dt>
        <dd>{texts.timeLimitOf(task.time_limit_s, task.observed === "simulation")}</dd>
      </dl>
    </Card>
  );
}
