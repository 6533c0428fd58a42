"""The viewer: results as one page of HTML that plays them, opens offline, and can be served."""
