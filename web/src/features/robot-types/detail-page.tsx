/** One robot type. */
import type { Device } from "../../shared/api/types";
import type { Fleet } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useCallback } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { degrees } from "../../shared/lib/angles";
import { readFindings } from "./model/parse-findings";
import { ApiError } from "../../shared/api/http";
import type { RobotType, TypeModel } from "../../shared/api/robot-types";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { ConfirmButton } from "../../shared/ui/confirm-button";
import { addRobotTypeAddress, deviceAddress, replaceWith, robotTypesAddress, tasksAddress } from "../../shared/routing/routes";
import { FindingsList } from "./findings-list";
import { ModelViewer } from "./model-viewer";
import { StartAgent } from "./start-agent";
import { StatusChip } from "./status-chip";
import { LoadError } from "../../shared/ui/load-error";
import { useResource } from "../../shared/hooks/use-resource";
import "./robot-types.css";

interface TypePageProps {
  api: Api;
  fleet: Fleet;
  id: string;
}

export function RobotTypePage({ api, fleet, id }: TypePageProps) {
  const { value: type, error, reload } = useResource(useCallback(() => api.robotTypes.get(id), [api, id]));
  const devices = [...(fleet.devices.value?.values() ?? [])]
    .map(({ info }) => info.value)
    .filter(({ robot_type: used }) => used === id);
  return (
    <main class="page fleet robot-types" id="content">
      <a href={robotTypesAddress}>← {texts.title}</a>
      {type === null && error === "" && (
        <p class="quiet" role="status">
          {common.loading}
        </p>
      )}
      <LoadError reason={error} retry={reload} />
      {type !== null && <Loaded api={api} type={type} devices={devices} />}
    </main>
  );
}

function Loaded({ api, type, devices }: { api: Api; type: RobotType; devices: readonly Device[] }) {
  const words = texts;
  const upload = type.upload;
  return (
    <>
      <header class="title-row">
        <h1>{type.label}</h1>
        <StatusChip type={type} />
      </header>
      <p>{type.description}</p>
      {type.state === "ready" && (
        <p>
          <a href={tasksAddress(type.type)} data-testid="to-tasks">
            {words.tasks}
          </a>
        </p>
      )}
      {upload?.state === "rejected" && <FindingsList findings={readFindings(upload.errors)} level="error" />}
      {upload !== null && <FindingsList findings={readFindings(upload.warnings)} level="warning" />}
      <div class="two">
        {type.state === "ready" ? <Model api={api} type={type} /> : <p class="quiet">{words.model.notReady}</p>}
        <Facts type={type} devices={devices} />
      </div>
      <Joints type={type} />
      <div class="two">
        <Movements api={api} type={type} />
        <Files api={api} type={type} />
      </div>
      {type.state === "ready" && devices.length === 0 && <StartAgent type={type.type} builtIn={type.built_in} />}
      {!type.built_in && <OwnerActions api={api} type={type} />}
    </>
  );
}

function Model({ api, type }: { api: Api; type: RobotType }) {
  const load = useCallback(async (): Promise<TypeModel | "none"> => {
    try {
      return await api.robotTypes.model(type.type);
    } catch (error) {
      if (error instanceof ApiError && error.code === "model-unknown") return "none";
      throw error;
    }
  }, [api, type]);
  const { value, error, reload } = useResource(load);
  if (error !== "") return <LoadError reason={error} retry={reload} />;
  if (value === null) return <p class="quiet">{common.loading}</p>;
  if (value === "none") return <p class="quiet">{texts.model.none}</p>;
  return <ModelViewer twin={value.twin} joints={type.joints} />;
}

function Facts({ type, devices }: { type: RobotType; devices: readonly Device[] }) {
  const words = texts;
  const upload = type.upload;
  return (
    <Card title={words.facts.title}>
      <dl class="facts">
        <dt>{words.facts.id}</dt>
        <dd>{type.type}</dd>
        <dt>{words.facts.kind}</dt>
        <dd>{type.kind}</dd>
        <dt>{words.column.version}</dt>
        <dd>
          {type.version} · {type.built_in ? words.facts.builtIn : words.facts.own}
        </dd>
        {upload !== null && (
          <>
            <dt>{words.facts.uploaded}</dt>
            <dd>{words.facts.upload(upload.version, format.dateTime(upload.uploaded_at))}</dd>
          </>
        )}
        <dt>{words.facts.driver}</dt>
        <dd>{type.driver}</dd>
        <dt>{words.facts.abilities}</dt>
        <dd>
          <ul class="row">
            {type.capabilities.map((name) => (
              <li key={name} class="chip">
                {name.replaceAll("_", " ")}
              </li>
            ))}
          </ul>
        </dd>
        <dt>{words.facts.frames}</dt>
        <dd>{type.frames.join(", ")}</dd>
      </dl>
      <h3>{words.facts.devices}</h3>
      {devices.length === 0 ? (
        <p class="quiet">{words.facts.noDevices}</p>
      ) : (
        <ul>
          {devices.map(({ id, label }) => (
            <li key={id}>
              <a href={deviceAddress(id)}>{label}</a>
            </li>
          ))}
        </ul>
      )}
    </Card>
  );
}

function Joints({ type }: { type: RobotType }) {
  const words = texts.joints;
  return (
    <Card title={words.title(type.joints.length)}>
      <div class="scroll" tabIndex={0} role="region" aria-label={words.title(type.joints.length)}>
        <table class="joint-table" data-testid="joint-table">
          <thead>
            <tr>
              <th scope="col">{words.name}</th>
              <th scope="col">{words.from}</th>
              <th scope="col">{words.to}</th>
              <th scope="col">{words.fastest}</th>
            </tr>
          </thead>
          <tbody>
            {type.joints.map((joint) => (
              <tr key={joint.name}>
                <th scope="row">
                  {joint.label} <span class="quiet small">{joint.name}</span>
                </th>
                <td>{format.degrees(degrees(joint.lower_rad))}</td>
                <td>{format.degrees(degrees(joint.upper_rad))}</td>
                <td>{words.speed(format.degrees(degrees(joint.max_velocity_rad_s)))}</td>
              </tr>
            ))}
          </tbody>
        </table>
      </div>
    </Card>
  );
}

function Movements({ api, type }: { api: Api; type: RobotType }) {
  const ready = type.state === "ready";
  const load = useCallback(() => (ready ? api.robotTypes.movements(type.type) : Promise.resolve([])), [api, type, ready]);
  const { value, error, reload } = useResource(load);
  return (
    <Card title={texts.movements.title}>
      <LoadError reason={error} retry={reload} />
      {value === null && error === "" && <p class="quiet">{common.loading}</p>}
      {value?.length === 0 && <p class="quiet">{texts.movements.none}</p>}
      {value !== null && value.length > 0 && (
        <ul class="plain-list" data-testid="type-movements">
          {value.map(({ name, description }) => (
            <li key={name}>
              <strong>{name}</strong> <span class="quiet small">{description}</span>
            </li>
          ))}
        </ul>
      )}
    </Card>
  );
}

function Files({ api, type }: { api: Api; type: RobotType }) {
  const words = texts.files;
  const ready = type.state === "ready";
  return (
    <Card
      title={words.title}
      aside={
        ready && (
          <a href={api.robotTypes.archiveAddress(type.type)} download={`${type.type}.zip`}>
            {words.all}
          </a>
        )
      }
    >
      <ul class="plain-list">
        {Object.entries(type.files).map(([name, length]) => (
          <li key={name}>
            {ready ? (
              <a href={api.robotTypes.fileAddress(type.type, name)} download={name.split("/").pop()}>
                {name}
              </a>
            ) : (
              name
            )}{" "}
            <span class="quiet small">{format.fileSize(length)}</span>
          </li>
        ))}
      </ul>
    </Card>
  );
}

function OwnerActions({ api, type }: { api: Api; type: RobotType }) {
  const words = texts.owned;
  return (
    <Card title={words.title}>
      <p>
        <a href={addRobotTypeAddress}>{words.next}</a>
      </p>
      <ConfirmButton
        label={words.remove}
        question={words.question(type.label)}
        confirmLabel={words.yes}
        busyLabel={words.busy}
        cancelLabel={words.keep}
        data-testid="delete-type"
        onConfirm={async () => {
          await api.robotTypes.delete(type.type);
          replaceWith(robotTypesAddress);
        }}
      />
    </Card>
  );
}
