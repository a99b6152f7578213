// Search from file://: browsers start no worker there, so its script runs in a hidden frame instead.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    #frame = document.createElement("iframe");
    #loaded = new Promise(done => this.#frame.addEventListener("load", done));

    constructor(url) {
      super();
      this.#frame.hidden = true;
      this.#frame.srcdoc =
        '<script>postMessage = data => parent.postMessage(data, "*")</script>' +
        `<script src="${url}"></script>`;
      addEventListener("message", event => {
        if (event.source === this.#frame.contentWindow) {
          this.dispatchEvent(new MessageEvent("message", {data: event.data}));
        }
      });
      document.body.append(this.#frame);
    }

    async postMessage(data) {
      await this.#loaded;
      this.#frame.contentWindow.dispatchEvent(new MessageEvent("message", {data}));
    }
  };
}
