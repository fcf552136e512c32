// A live environment: its socket, the newest frame, and what the server says about it.

export interface Header {
  number: number;
  step: number;
  reward: number;
  total: number;
  success: boolean;
  terminated: boolean;
  truncated: boolean;
  playing: boolean;
  recorded: number | null;
  state: number[];
}

export interface Started {
  seed: number;
  factors: Record<string, number[]>;
  command: string;
  python: string | null;
}

export interface Recording {
  dataset: string | null;
  episodes: number;
  rows: number;
  complete: boolean;
}

export type Send = (type: string, fields?: Record<string, unknown>) => void;

export interface Session {
  send: Send;
  close: () => void;
}

export type Reply = { type: string } & Record<string, unknown>;

interface Socket<H> {
  arrived?: () => void;
  frame: (header: H, image: ImageBitmap) => void;
  reply: (reply: Reply) => void;
  closed: () => void;
}

// Opens the socket of a session. Messages that are sent before it is open wait.
export function open<H>(route: string, env: string, image: number, events: Socket<H>): Session {
  const url = new URL(`api/${route}`, location.href);
  url.protocol = url.protocol.replace("http", "ws");
  url.hash = "";
  url.search = new URLSearchParams({ env, image: String(image) }).toString();
  const socket = new WebSocket(url);
  socket.binaryType = "arraybuffer";
  let isOpen = true;
  const waiting: string[] = [];
  const send: Send = (type, fields = {}) => {
    const text = JSON.stringify({ type, ...fields });
    if (socket.readyState === WebSocket.OPEN) socket.send(text);
    else if (socket.readyState === WebSocket.CONNECTING) waiting.push(text);
  };
  socket.onopen = () => waiting.splice(0).forEach((text) => socket.send(text));
  socket.onclose = () => {
    if (isOpen) events.closed();
  };
  const show = async (data: ArrayBuffer) => {
    const size = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size))) as H;
    const image = await createImageBitmap(new Blob([new Uint8Array(data, 4 + size)], { type: "image/jpeg" }));
    // The server sends another frame when this one is on its way to the screen.
    requestAnimationFrame(() => {
      if (isOpen) {
        events.frame(header, image);
        send("shown");
      }
      image.close();
    });
  };
  socket.onmessage = (message) => {
    if (typeof message.data !== "string") {
      events.arrived?.();
      void show(message.data);
      return;
    }
    events.reply(JSON.parse(message.data));
  };
  return {
    send,
    close: () => {
      isOpen = false;
      socket.close();
    },
  };
}
