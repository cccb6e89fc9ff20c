/** Moving time by task, and how operators and machine worked together. */
import type { Autonomy } from "../../shared/api/autonomy";
import { format } from "../../shared/i18n/format";
import { Card } from "../../shared/ui/card";
import { durationText, shareText } from "./model";
import { texts } from "./texts";

export function TasksCard({ autonomy }: { autonomy: Autonomy }) {
  const { interventions, actions, takeover_s: takeoverS, workload } = autonomy;
  const figures = [
    ["interventions", texts.figures.interventions, interventions, texts.ofActions(interventions, actions)],
    ["takeover", texts.figures.takeover, takeoverS, takeoverS === null ? format.unknown : durationText(takeoverS)],
    ["workload", texts.figures.workload, workload, workload === null ? format.unknown : shareText(workload)],
  ] as const;
  return (
    <Card title={texts.tasks}>
      {autonomy.tasks.length === 0 ? <p class="quiet">{texts.noTasks}</p> : <TaskTable tasks={autonomy.tasks} />}
      <dl class="metrics in-a-row">
        {figures.map(([id, [name, meaning], value, text]) => (
          <div key={id} data-testid={`figure-${id}`} data-value={value ?? ""}>
            <dt>{name}</dt>
            <dd>
              <strong>{text}</strong>
              <span class="quiet small">{meaning}</span>
            </dd>
          </div>
        ))}
      </dl>
    </Card>
  );
}

function TaskTable({ tasks }: { tasks: Autonomy["tasks"] }) {
  return (
    <div class="scroll" tabIndex={0} role="region" aria-label={texts.tasks}>
      <table>
        <thead>
          <tr>
            {texts.taskColumns.map((name) => (
              <th key={name} scope="col">
                {name}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>
          {tasks.map(({ name, share }) => (
            <tr key={name} data-testid="task" data-task={name}>
              <th scope="row">{texts.task(name)}</th>
              <td>{durationText(share.operator_s + share.machine_s)}</td>
              <td>{share.hti === null ? format.unknown : shareText(share.hti)}</td>
              <td>{share.mti === null ? format.unknown : shareText(share.mti)}</td>
            </tr>
          ))}
        </tbody>
      </table>
    </div>
  );
}
