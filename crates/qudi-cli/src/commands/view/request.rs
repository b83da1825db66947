//! Requests to the server: what is answered, and what is refused.

use super::address::Address;

/// Bytes of a request at most.
pub(super) const MAX_REQUEST_BYTES: usize = 8192;

/// What a request asks for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Route {
    Page,
    /// A frame of a layer, by its name.
    Frame {
        layer: String,
        frame: u64,
    },
}

/// Why a request is refused: status and text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Refusal {
    pub(super) status: &'static str,
    pub(super) text: &'static str,
}

const MALFORMED: Refusal = Refusal { status: "400 Bad Request", text: "not a request of HTTP/1.1" };
pub(super) const TOO_LARGE: Refusal =
    Refusal { status: "431 Request Header Fields Too Large", text: "the request is too large" };
const METHOD: Refusal = Refusal { status: "405 Method Not Allowed", text: "GET only" };
const FOREIGN: Refusal = Refusal {
    status: "403 Forbidden",
    text: "for browsers on this computer, at the printed address",
};
const UNKNOWN: Refusal = Refusal { status: "404 Not Found", text: "nothing here" };

/// Returns what a request asks for, from its lines up to the empty one. Host and Origin are checked before
/// the path, and the token before anything is told of what there is.
///
/// # Errors
/// [`Refusal`] for anything but GET of the page or of a frame, by a page of this server or by its user.
pub(super) fn route(head: &str, address: &Address) -> Result<Route, Refusal> {
    let mut lines = head.split("\r\n");
    let words: Vec<&str> = lines.next().unwrap_or_default().split(' ').collect();
    let [method, target, version] = words[..] else { return Err(MALFORMED) };
    if !version.starts_with("HTTP/1.") {
        return Err(MALFORMED);
    }
    let headers = lines.take_while(|line| !line.is_empty()).map(|line| line.split_once(':'));
    let headers: Vec<(&str, &str)> = headers.collect::<Option<_>>().ok_or(MALFORMED)?;
    let values = |name: &str| -> Vec<&str> {
        let named = headers.iter().filter(|(key, _)| key.eq_ignore_ascii_case(name));
        named.map(|(_, value)| value.trim()).collect()
    };
    if method != "GET" {
        return Err(METHOD);
    }
    match values("host")[..] {
        [host] if address.is_host(host) => {}
        [_] => return Err(FOREIGN),
        _ => return Err(MALFORMED),
    }
    if !values("origin").into_iter().all(|origin| address.is_origin(origin)) {
        return Err(FOREIGN);
    }
    // Links and pictures on pages of other sites.
    let is_own = |site: &str| matches!(site, "same-origin" | "none");
    if !values("sec-fetch-site").into_iter().all(is_own) {
        return Err(FOREIGN);
    }
    let path = address.strip_token(target).ok_or(UNKNOWN)?;
    if path.is_empty() {
        return Ok(Route::Page);
    }
    let parts: Vec<&str> = path.split('/').collect();
    let ["frame", layer, number] = parts[..] else { return Err(UNKNOWN) };
    let is_number = !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit());
    match number.parse() {
        Ok(frame) if is_number => Ok(Route::Frame { layer: layer.to_owned(), frame }),
        _ => Err(UNKNOWN),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(request: &str) -> Result<Route, Refusal> {
        let head = request.replace('\n', "\r\n") + "\r\n\r\n";
        route(&head, &Address::known(8000, "t0ken"))
    }

    #[test]
    fn page_and_frames_are_answered() {
        for host in ["127.0.0.1:8000", "localhost:8000", "LOCALHOST:8000"] {
            assert_eq!(asked(&format!("GET /t0ken/ HTTP/1.1\nHost: {host}")), Ok(Route::Page));
        }
        let frame = asked(
            "GET /t0ken/frame/qudi/12 HTTP/1.1\nhost: 127.0.0.1:8000\nSec-Fetch-Site: same-origin\nOrigin: http://127.0.0.1:8000",
        );
        assert_eq!(frame, Ok(Route::Frame { layer: "qudi".to_owned(), frame: 12 }));
        let typed = "GET /t0ken/ HTTP/1.1\nHost: 127.0.0.1:8000\nSec-Fetch-Site: none";
        assert_eq!(asked(typed), Ok(Route::Page));
    }

    #[test]
    fn other_methods_are_refused() {
        for method in ["POST", "PUT", "DELETE", "HEAD", "OPTIONS", "CONNECT", "get"] {
            let request = format!("{method} /t0ken/ HTTP/1.1\nHost: 127.0.0.1:8000");
            assert_eq!(asked(&request), Err(METHOD), "{method}");
        }
    }

    #[test]
    fn foreign_hosts_and_origins_are_refused() {
        for line in [
            "Host: evil.example",
            "Host: evil.example:8000",
            "Host: 127.0.0.1",
            "Host: 127.0.0.1:8001",
            "Host: 127.0.0.1:8000.evil.example",
            "Host: 0.0.0.0:8000",
            "Host: 127.0.0.1:8000\nOrigin: http://evil.example",
            "Host: 127.0.0.1:8000\nOrigin: null",
            "Host: 127.0.0.1:8000\nOrigin: https://127.0.0.1:8000",
            "Host: 127.0.0.1:8000\nSec-Fetch-Site: cross-site",
            "Host: 127.0.0.1:8000\nSec-Fetch-Site: same-site",
        ] {
            assert_eq!(asked(&format!("GET /t0ken/ HTTP/1.1\n{line}")), Err(FOREIGN), "{line}");
        }
    }

    #[test]
    fn unknown_paths_and_tokens_are_refused() {
        for path in [
            "/",
            "/t0ke/",
            "/t0ken",
            "/t0ken/../",
            "/t0ken/index.html",
            "/t0ken/frame",
            "/t0ken/frame/qudi",
            "/t0ken/frame/qudi/x",
            "/t0ken/frame/qudi/-1",
            "/t0ken/frame/qudi/+1",
            "/t0ken/frame/qudi/1/",
            "/t0ken/frame/qudi/99999999999999999999",
            "/t0ken/?a",
            "/frame/qudi/1",
            "/etc/passwd",
            "http://127.0.0.1:8000/t0ken/",
        ] {
            let request = format!("GET {path} HTTP/1.1\nHost: 127.0.0.1:8000");
            assert_eq!(asked(&request), Err(UNKNOWN), "{path}");
        }
    }

    #[test]
    fn malformed_requests_are_refused() {
        for request in [
            "",
            "GET",
            "GET /t0ken/",
            "GET /t0ken/ HTTP/2",
            "GET  /t0ken/ HTTP/1.1\nHost: 127.0.0.1:8000",
            "GET /t0ken/ HTTP/1.1",
            "GET /t0ken/ HTTP/1.1\nno header",
            "GET /t0ken/ HTTP/1.1\nHost: 127.0.0.1:8000\nHost: 127.0.0.1:8000",
        ] {
            assert_eq!(asked(request), Err(MALFORMED), "{request}");
        }
    }
}
