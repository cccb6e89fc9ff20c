/** All versions of a movement: compare one with the editor, and restore it. */
import { Card } from "../../shared/ui/card";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import type { Movement } from "../../shared/api/movement-library";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { Comparison } from "./code-editor";

/** Two texts with their differences. */
export function ScriptDiff({ before, after, label }: { before: string; after: string; label: string }) {
  const host = useRef<HTMLDivElement>(null);
  useEffect(() => {
    if (host.current === null) return undefined;
    const comparison = new Comparison(host.current, before, after, label);
    return () => comparison.dispose();
  }, [before, after, label]);
  return <div class="code-editor difference" data-testid="difference" ref={host} />;
}

interface VersionsProps {
  api: Api;
  robotType: string;
  name: string;
  /** The newest version; the list is reloaded when it changes. */
  newest: number;
  text: string;
  onRestore: (source: string) => Promise<void>;
}

export function VersionList({ api, robotType, name, newest, text, onRestore }: VersionsProps) {
  const [versions, setVersions] = useState<readonly Movement[]>([]);
  const [opened, setOpened] = useState<{ version: number; source: string } | null>(null);
  const [error, setError] = useState("");
  const [working, setWorking] = useState(false);
  useEffect(() => {
    let active = true;
    setOpened(null);
    if (newest === 0) return undefined;
    api.library.versions(robotType, name).then(
      (found) => active && setVersions(found),
      (error: unknown) => active && setError(sentence(error)),
    );
    return () => {
      active = false;
    };
  }, [api, robotType, name, newest]);

  const attempt = async (work: () => Promise<void>): Promise<void> => {
    setWorking(true);
    setError("");
    try {
      await work();
    } catch (error) {
      setError(sentence(error));
    } finally {
      setWorking(false);
    }
  };
  const open = (version: number): Promise<void> =>
    attempt(async () => {
      setOpened({ version, source: (await api.library.get(robotType, name, version)).source });
    });

  if (newest === 0) return null;
  return (
    <Card title={texts.versions.title} class="versions">
      <ul class="version-list">
        {versions.map((version) => (
          <li key={`${version.version}-${String(version.built_in)}`} data-testid={`version-${version.version}`}>
            <span>
              <strong>{texts.versions.one(version.version)}</strong>{" "}
              <span class="quiet small">
                {version.built_in ? texts.library.builtIn : format.dateTime(version.updated_at)}
              </span>
            </span>
            <button
              type="button"
              class="plain"
              aria-expanded={opened?.version === version.version}
              aria-label={opened?.version === version.version ? texts.versions.closeOf(version.version) : texts.versions.viewVersion(version.version)}
              disabled={working}
              onClick={() => (opened?.version === version.version ? setOpened(null) : void open(version.version))}
            >
              {opened?.version === version.version ? texts.versions.close : texts.versions.view}
            </button>
          </li>
        ))}
      </ul>
      <p class="field-error" role="alert">
        {error}
      </p>
      {opened !== null && (
        <section class="opened-version" aria-label={texts.versions.one(opened.version)}>
          <p class="quiet small">
            {opened.source === text ? texts.versions.same(opened.version) : texts.versions.explain(opened.version)}
          </p>
          <ScriptDiff before={opened.source} after={text} label={texts.versions.label(opened.version)} />
          {opened.source !== text && (
            <button
              type="button"
              data-testid="restore-version"
              disabled={working}
              onClick={() => void attempt(() => onRestore(opened.source))}
            >
              {working ? texts.editor.saving : texts.versions.restore(opened.version)}
            </button>
          )}
        </section>
      )}
    </Card>
  );
}
