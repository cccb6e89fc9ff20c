/** The tasks of one robot type. */
import type { Api } from "../../../shared/api/client";
import { robotTypeAddress } from "../../../shared/routing/routes";
import { TaskListCard } from "./task-list-card";
import { texts } from "./texts";

export function TaskListPage({ api, robotType }: { api: Api; robotType: string }) {
  return (
    <main class="page fleet task-page" id="content">
      <a href={robotTypeAddress(robotType)}>← {robotType.replaceAll("_", " ")}</a>
      <h1>{texts.title}</h1>
      <TaskListCard api={api} robotType={robotType} />
    </main>
  );
}
