/** The tasks of a robot type with their success rates. */
import { useCallback } from "preact/hooks";
import type { Api } from "../../../shared/api/client";
import { ApiError } from "../../../shared/api/http";
import type { Task } from "../../../shared/api/tasks";
import { useResource } from "../../../shared/hooks/use-resource";
import { common } from "../../../shared/i18n/common";
import { taskAddress } from "../../../shared/routing/routes";
import { Card } from "../../../shared/ui/card";
import { LoadError } from "../../../shared/ui/load-error";
import { RateBar } from "./rate-bar";
import { texts } from "./texts";
import "./tasks.css";

export function TaskListCard({ api, robotType }: { api: Api; robotType: string }) {
  const load = useCallback(async (): Promise<Task[]> => {
    try {
      return await api.tasks.list(robotType);
    } catch (error) {
      // The type of a shared robot may belong to its owner only.
      if (error instanceof ApiError && error.code === "robot-type-unknown") return [];
      throw error;
    }
  }, [api, robotType]);
  const { value, error, reload } = useResource(load);
  return (
    <Card title={texts.titleOf(robotType)} data-testid="task-list">
      <p class="quiet small">{texts.listExplained}</p>
      <LoadError reason={error} retry={reload} />
      {value === null && error === "" && <p class="quiet">{common.loading}</p>}
      {value?.length === 0 && <p class="quiet">{texts.none}</p>}
      {value !== null && value.length > 0 && <TaskTable robotType={robotType} tasks={value} />}
    </Card>
  );
}

function TaskTable({ robotType, tasks }: { robotType: string; tasks: readonly Task[] }) {
  return (
    <div class="scroll" tabIndex={0} role="region" aria-label={texts.title}>
      <table class="rate-table">
        <thead>
          <tr>
            {texts.columns.map((name) => (
              <th key={name} scope="col">
                {name}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>
          {tasks.map(({ name, label, rate }) => (
            <tr key={name} data-testid="task-row" data-task={name}>
              <th scope="row">
                <a href={taskAddress(robotType, name)}>{label}</a>
              </th>
              <td>
                <RateBar rate={rate} />
              </td>
              <td>{texts.successes(rate.successes, rate.trials)}</td>
            </tr>
          ))}
        </tbody>
      </table>
    </div>
  );
}
