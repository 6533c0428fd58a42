// Pictures in the making. The background is drawn once for a view. Under every frame its colours are copied to the
// canvas, and its depths hide what moves behind it.

class Targets {
  constructor(gl) {
    this.gl = gl;
    this.size = [0, 0];
  }

  // Returns whether the size changed.
  resize(width, height) {
    if (this.size[0] === width && this.size[1] === height) return false;
    for (const name of ["shown", "next"]) {
      if (this[name]) this.remove(this[name]);
      this[name] = this.make(width, height);
    }
    this.size = [width, height];
    return true;
  }

  make(width, height) {
    const { gl } = this;
    const buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    const colors = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, colors);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, colors);
    const depths = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, depths);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, width, height);
    for (const name of ["TEXTURE_MIN_FILTER", "TEXTURE_MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_2D, gl[name], gl.NEAREST);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depths, 0);
    return { buffer, colors, depths };
  }

  remove({ buffer, colors, depths }) {
    this.gl.deleteFramebuffer(buffer);
    this.gl.deleteRenderbuffer(colors);
    this.gl.deleteTexture(depths);
  }

  // Starts a background.
  begin(target) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(...BACKGROUND, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  // Starts a frame: the canvas with the colours of the background, and depths of its own.
  beginFrame() {
    const { gl } = this;
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT); // first: browsers clear the canvas late, over a copy
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.shown.buffer);
    const corners = [0, 0, ...this.size];
    gl.blitFramebuffer(...corners, ...corners, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }
}
