// A browser starts no worker from a file. The search of this site is a worker: run it in a hidden frame instead.
(() => {
  if (location.protocol !== "file:") return;

  const append = (page, url) =>
    new Promise((done, failed) => {
      const script = page.createElement("script");
      script.onload = done;
      script.onerror = () => failed(new Error(`cannot load ${url}`));
      script.src = url;
      page.head.appendChild(script);
    });

  class FrameWorker extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.appendChild(this.frame);
      this.inside = this.frame.contentWindow;
      this.inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      this.inside.importScripts = (...urls) => Promise.all(urls.map((each) => append(this.inside.document, each)));
      this.ready = append(this.inside.document, new URL(url, location.href).href);
    }

    postMessage(data) {
      this.ready.then(() => this.inside.dispatchEvent(new MessageEvent("message", { data })));
    }

    terminate() {
      this.frame.remove();
    }
  }

  window.IFrameWorker = FrameWorker; // the name that the search looks for
  window.Worker = FrameWorker;
})();
