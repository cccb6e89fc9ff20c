/** All robot types that the account can access. */
import type { Fleet } from "../devices/model";
import { PageExplainer } from "../../shared/help";
import { useCallback } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import type { RobotType } from "../../shared/api/robot-types";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { addRobotTypeAddress, robotTypeAddress } from "../../shared/routing/routes";
import { LoadError } from "../../shared/ui/load-error";
import { StatusChip } from "./status-chip";
import { useResource } from "../../shared/hooks/use-resource";
import "./robot-types.css";

export function RobotTypesPage({ api, fleet }: { api: Api; fleet: Fleet }) {
  const { value: types, error, reload } = useResource(useCallback(() => api.robotTypes.list(), [api]));
  const words = texts;
  const own = types?.filter((type) => !type.built_in) ?? [];
  const builtIn = types?.filter((type) => type.built_in) ?? [];
  return (
    <main class="page fleet robot-types" id="content">
      <header class="title-row">
        <h1>{words.title}</h1>
        <a class="button primary" href={addRobotTypeAddress} data-testid="add-robot-type">
          {words.add}
        </a>
      </header>
      <p class="quiet">{words.explained}</p>
      <PageExplainer page="robotTypes" />
      {types === null && error === "" && (
        <p class="quiet" role="status">
          {common.loading}
        </p>
      )}
      <LoadError reason={error} retry={reload} />
      {types !== null && (
        <>
          <section aria-label={words.own}>
            <h2>{words.own}</h2>
            {own.length === 0 ? <p class="quiet">{words.noneOwn}</p> : <Types types={own} fleet={fleet} name={words.own} />}
          </section>
          <section aria-label={words.builtIn}>
            <h2>{words.builtIn}</h2>
            <Types types={builtIn} fleet={fleet} name={words.builtIn} />
          </section>
        </>
      )}
    </main>
  );
}

function Types({ types, fleet, name }: { types: readonly RobotType[]; fleet: Fleet; name: string }) {
  const words = texts;
  const devices = [...(fleet.devices.value?.values() ?? [])].map(({ info }) => info.value);
  return (
    <ul class="devices" aria-label={name}>
      {types.map((type) => (
        <li key={type.type} class="card device-row" data-testid="type-row" data-type={type.type}>
          <a class="device-name" href={robotTypeAddress(type.type)}>
            {type.label}
            <span class="quiet">
              {type.type} · {type.kind}
            </span>
          </a>
          <dl>
            <div>
              <dt>{words.column.version}</dt>
              <dd>{type.version}</dd>
            </div>
            <div>
              <dt>{words.column.joints}</dt>
              <dd>{type.joints.length}</dd>
            </div>
            <div>
              <dt>{words.column.users}</dt>
              <dd>{words.users(devices.filter(({ robot_type: used }) => used === type.type).length)}</dd>
            </div>
            <div>
              <dt>{words.column.state}</dt>
              <dd>
                <StatusChip type={type} />
              </dd>
            </div>
          </dl>
        </li>
      ))}
    </ul>
  );
}
