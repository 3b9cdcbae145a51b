"""How frames and poses reach a page: WebRTC and motion JPEG."""
