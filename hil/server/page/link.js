// The connection to the server: JSON both ways, blocks of telemetry from there. Comes back by itself.

const PREFIX = "token.";

export class Link {
  /** `on`: by kind of message (status, answer, control, event, hello, preview, block, gone), what to do with it. */
  constructor(on) {
    this.on = on;
    this.token = location.hash.slice(1) || sessionStorage.getItem("token") || "";
    sessionStorage.setItem("token", this.token);
    history.replaceState(null, "", location.pathname);  // not in the history, nor in a screenshot
    this.tags = 0;
    this.open();
  }

  open() {
    const address = location.origin.replace("http", "ws") + "/stage";
    this.socket = new WebSocket(address, ["pkxyz.1", PREFIX + this.token]);
    this.socket.binaryType = "arraybuffer";
    let wasOpen = false;
    this.socket.onopen = () => { wasOpen = true; this.on.open?.(); };
    this.socket.onmessage = ({ data }) => {
      if (data instanceof ArrayBuffer) return this.on.block(unpacked(data));
      for (const [kind, value] of Object.entries(JSON.parse(data))) this.on[kind]?.(value);
    };
    this.socket.onclose = ({ code, reason }) => { this.on.gone(`${code} ${reason}`.trim(), wasOpen); setTimeout(() => this.open(), 1000); };
  }

  say(message) {
    if (this.socket.readyState !== WebSocket.OPEN) return null;
    const tag = `p${++this.tags}`;
    this.socket.send(JSON.stringify({ ...message, tag }));
    return tag;
  }
}

/** A block as the server packs it: {first, count, lost, columns: {field: Float32Array}}; fields of three run x y z x y z. */
export function unpacked(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const columns = {};
  let at = 4 + length;
  for (const [name, width] of head.fields) {
    columns[name] = { width, values: new Float32Array(buffer, at, head.count * width) };
    at += 4 * head.count * width;
  }
  return { first: head.first, count: head.count, lost: head.lost, columns };
}
