/** Selects robot type files: dropped, or chosen as folder, archive or single files. They stay until saved. */
import { Card } from "../../shared/ui/card";
import { useRef, useState } from "preact/hooks";
import type { UploadDraft } from "./model/upload-draft";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { ArchiveError, filesFromDrop, filesFromPicker, readFiles } from "./read-archive";

const ACCEPTED = ".zip,.toml,.xml,.stl,.obj,.png,.py";

export function FilePicker({ draft }: { draft: UploadDraft }) {
  const [dragging, setDragging] = useState(false);
  const [reading, setReading] = useState(false);
  const [error, setError] = useState("");
  const folder = useRef<HTMLInputElement>(null);
  const files = useRef<HTMLInputElement>(null);
  const words = texts.adding;

  const addFiles = async (chosen: Promise<[string, File][]>): Promise<void> => {
    setError("");
    setReading(true);
    try {
      const contents = await readFiles(await chosen);
      setReading(false);
      if (contents.size > 0) await draft.add(contents);
    } catch (error) {
      setError(error instanceof ArchiveError ? words.badArchive(error.message) : words.unreadable);
    } finally {
      setReading(false);
    }
  };
  const input = (event: { currentTarget: HTMLInputElement }): void => {
    void addFiles(Promise.resolve(filesFromPicker(event.currentTarget.files)));
    // Allows choosing the same file again after a correction.
    event.currentTarget.value = "";
  };
  return (
    <div
      class={`drop ${dragging ? "dragging" : ""}`}
      data-testid="drop-files"
      onDragOver={(event) => {
        event.preventDefault();
        setDragging(true);
      }}
      onDragLeave={() => setDragging(false)}
      onDrop={(event) => {
        event.preventDefault();
        setDragging(false);
        if (event.dataTransfer !== null) void addFiles(filesFromDrop(event.dataTransfer));
      }}
    >
      <p>{words.drop}</p>
      <div class="row">
        <button type="button" class="primary" onClick={() => files.current?.click()}>
          {words.chooseFiles}
        </button>
        <button type="button" onClick={() => folder.current?.click()}>
          {words.chooseFolder}
        </button>
      </div>
      <input
        ref={files}
        class="visually-hidden"
        type="file"
        multiple
        accept={ACCEPTED}
        tabIndex={-1}
        aria-label={words.chooseFiles}
        data-testid="type-files"
        onChange={input}
      />
      <input
        ref={(each) => {
          folder.current = each;
          each?.setAttribute("webkitdirectory", "");
        }}
        class="visually-hidden"
        type="file"
        tabIndex={-1}
        aria-label={words.chooseFolder}
        data-testid="type-folder"
        onChange={input}
      />
      <p class="field-error" role="alert">
        {error}
      </p>
      {reading && <p role="status">{words.reading}</p>}
    </div>
  );
}

export function SelectedFiles({ draft }: { draft: UploadDraft }) {
  const names = [...draft.files.value.keys()].sort();
  const ignored = draft.ignored.value;
  const words = texts.adding;
  if (names.length === 0 && ignored.length === 0) return null;
  const filesWithErrors = new Set(draft.errors.value.map(({ file }) => file));
  return (
    <Card
      title={words.chosen}
      aside={
        names.length > 0 && (
          <button type="button" class="plain" onClick={() => void draft.clear()}>
            {words.clear}
          </button>
        )
      }
    >
      <ul class="type-files" aria-label={words.chosen} data-testid="chosen-files">
        {names.map((name) => (
          <FileRow key={name} draft={draft} name={name} hasErrors={filesWithErrors.has(name)} />
        ))}
      </ul>
      {ignored.length > 0 && <p class="quiet small">{words.ignored(ignored)}</p>}
    </Card>
  );
}

function FileRow({ draft, name, hasErrors }: { draft: UploadDraft; name: string; hasErrors: boolean }) {
  const input = useRef<HTMLInputElement>(null);
  const words = texts.adding;
  return (
    <li data-file={name}>
      <span class="file-name">
        {name} <span class="quiet small">{format.fileSize(draft.files.value.get(name)?.length ?? 0)}</span>{" "}
        {hasErrors && <span class="chip bad">{words.hasErrors}</span>}
      </span>
      <button type="button" class="plain" aria-label={words.replaceNamed(name)} onClick={() => input.current?.click()}>
        {words.replace}
      </button>
      <button type="button" class="plain" aria-label={words.removeNamed(name)} onClick={() => void draft.remove(name)}>
        {words.remove}
      </button>
      <input
        ref={input}
        class="visually-hidden"
        type="file"
        tabIndex={-1}
        aria-label={words.replaceNamed(name)}
        onChange={(event) => {
          const file = event.currentTarget.files?.[0];
          event.currentTarget.value = "";
          if (file !== undefined) void file.arrayBuffer().then((content) => draft.replace(name, new Uint8Array(content)));
        }}
      />
    </li>
  );
}
