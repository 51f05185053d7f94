// What Python computes: moments, rows and controls come over a WebSocket, and what the reader asks for goes back.
"use strict";

const LEAST_PAUSE = 60; // ms, between two messages to Python, which takes no more than 20 per second

class Stream {
  constructor(page) {
    this.page = page;
    page.stream = this;
    this.moment = null;
    this.asked = new Map(); // what goes to Python next, by the name of a control
    this.controls = new Map();
    page.find("speed").addEventListener("change", ({ target }) => page.isLive && this.ask("speed", Number(target.value)));
    page.addChip("Live", () => {
      this.open();
      page.find("view").focus({ preventScroll: true });
    });
    page.find("chips").prepend(page.find("chips").lastChild);
    setInterval(() => this.send(), LEAST_PAUSE);
    if (!page.given) this.open(); // a link to a drive shows the drive
  }

  /** Shows the stream, and connects. */
  open() {
    this.page.setOpen("Live", true);
    this.page.find("text").textContent = "";
    this.page.find("controls").hidden = true;
    this.page.showRows([]);
    this.connect();
  }

  connect() {
    this.close();
    const socket = (this.socket = new WebSocket(`${location.origin.replace("http", "ws")}/stream`));
    socket.onmessage = ({ data }) => {
      const { moment, panel, status } = JSON.parse(data);
      if (moment) this.moment = moment;
      if (panel) this.setPanel(panel);
      if (status) this.setStatus(status);
    };
    socket.onclose = () => {
      if (socket !== this.socket) return; // it was left
      this.page.find("text").textContent = "The program has ended, or has too many pages. This page connects again when it can.";
      setTimeout(() => socket === this.socket && this.connect(), 1000);
    };
  }

  /** Leaves the stream. The simulation pauses while no page is connected. */
  close() {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
  }

  ask(name, value) {
    this.asked.delete(name);
    this.asked.set(name, value);
  }

  press(key) {
    if (key === "n") this.ask("Episode", "random");
    return key === "n";
  }

  /** Sends the first thing that was asked for; of what is asked for again and again, the last. */
  send() {
    const [first] = this.asked;
    if (!first || this.socket?.readyState !== WebSocket.OPEN) return;
    this.asked.delete(first[0]);
    this.socket.send(JSON.stringify(first));
  }

  /** Numbers and words, which change all the time. */
  setStatus({ text, clock, rows, playing, speed }) {
    const { page } = this;
    const said = page.find("text");
    if (said.textContent !== text) said.textContent = text; // a screen reader reads it out
    page.find("controls").hidden = false;
    page.find("clock").textContent = clock;
    if (!page.find("speed").matches(":focus-visible, :active")) page.find("speed").value = speed;
    Player.prototype.setPlaying.call(page, playing);
    page.showRows(rows);
  }

  /** Controls {name, group, value, options | limits}; without a value they are buttons. */
  setPanel(controls) {
    const kinds = JSON.stringify(controls.map(({ value, ...kind }) => kind));
    if (kinds !== this.kinds) this.build(controls);
    this.kinds = kinds;
    for (const { name, value } of controls) {
      const { input, output } = this.controls.get(name);
      if (this.asked.has(name) || input.matches(":active")) continue; // the reader changes it
      if (input.type === "checkbox") input.checked = value;
      else if (value !== null) input.value = value;
      if (output) output.textContent = value;
    }
  }

  build(controls) {
    const panel = this.page.find("panel");
    const open = new Set([...panel.querySelectorAll("details[open]")].map((details) => details.dataset.group));
    panel.replaceChildren();
    const groups = new Map([["", panel]]);
    for (const control of controls) {
      if (!groups.has(control.group)) {
        const details = document.createElement("details");
        const summary = document.createElement("summary");
        summary.textContent = details.dataset.group = control.group;
        details.open = open.has(control.group);
        details.append(summary);
        panel.append(details);
        groups.set(control.group, details);
      }
      groups.get(control.group).append(this.element(control));
    }
  }

  /** The element of a control, with its name in it. */
  element({ name, value, options, limits }) {
    const isButton = value === null;
    const input = document.createElement(isButton ? "button" : options ? "select" : "input");
    if (isButton) Object.assign(input, { type: "button", textContent: name, onclick: () => this.ask(name, true) });
    else if (options) input.replaceChildren(...options.map((option) => new Option(option, option)));
    else if (limits) Object.assign(input, { type: "range", min: limits[0], max: limits[1], step: limits[2] });
    else input.type = "checkbox";
    const output = limits ? document.createElement("output") : null;
    this.controls.set(name, { input, output });
    if (isButton) return input;
    input.oninput = () => {
      const read = limits ? Number(input.value) : options ? input.value : input.checked;
      if (output) output.textContent = read;
      this.ask(name, read);
    };
    const label = document.createElement("label");
    label.append(...(options || limits ? [`${name} `, input] : [input, ` ${name}`]));
    if (output) label.append(output);
    return label;
  }
}
