// The search of a page that is read from the disk: browsers refuse workers there, so their script runs in a frame.
// The theme looks for this name; without the file it would load one from another server.
window.IFrameWorker = class extends EventTarget {
  constructor(url) {
    super()
    const frame = document.createElement("iframe")
    frame.hidden = true
    document.body.append(frame)
    const inner = this.inner = frame.contentWindow
    inner.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }))
    inner.importScripts = (...urls) => urls.reduce((done, url) => done.then(() => load(url)), Promise.resolve())
    const load = src => new Promise((resolve, reject) => {
      const script = Object.assign(inner.document.createElement("script"), { src, onload: resolve, onerror: reject })
      inner.document.body.append(script)
    })
    this.ready = load(new URL(url, document.baseURI).href)
  }
  postMessage(data) {
    this.ready.then(() => this.inner.dispatchEvent(new MessageEvent("message", { data })))
  }
  terminate() {
    this.inner.frameElement.remove()
  }
}
if (location.protocol === "file:") window.Worker = window.IFrameWorker
