//! One source for the blocking and the async flavour of a driver.
//!
//! Without this the blocking flavour would be the async one, polled once. As a state machine it takes twice the flash, for
//! the compiler keeps for each `async fn` what it needs to be left and resumed.

use proc_macro::{Delimiter, Group, Ident, TokenStream, TokenTree};

/// Makes two items of one that is written for the async flavour.
///
/// The first one is the item as it stands, if the feature `async` is on. The second one is for a blocking bus: the same without
/// `async` and `.await`, and with `embedded_hal` for `embedded_hal_async`, `Blocking` for `Asynchronous`.
#[proc_macro_attribute]
pub fn both_flavours(_: TokenStream, item: TokenStream) -> TokenStream {
    let mut both: TokenStream = "#[cfg(feature = \"async\")]".parse().unwrap_or_default();
    both.extend(item.clone());
    both.extend(blocking(item));
    both
}

fn blocking(tokens: TokenStream) -> TokenStream {
    let mut tokens = tokens.into_iter().peekable();
    let mut kept = TokenStream::new();
    while let Some(token) = tokens.next() {
        let token = match token {
            TokenTree::Ident(name) => match renamed(&name) {
                Some(name) => TokenTree::Ident(name),
                None => continue,
            },
            TokenTree::Punct(dot) if dot.as_char() == '.' && tokens.next_if(is_await).is_some() => {
                continue;
            }
            TokenTree::Group(group) => within(&group),
            other => other,
        };
        kept.extend([token]);
    }
    kept
}

fn is_await(token: &TokenTree) -> bool {
    matches!(token, TokenTree::Ident(name) if name.to_string() == "await")
}

/// The name in the blocking flavour; `None` when it has no place there.
fn renamed(name: &Ident) -> Option<Ident> {
    let new = match name.to_string().as_str() {
        "async" => return None,
        "embedded_hal_async" => "embedded_hal",
        "Asynchronous" => "Blocking",
        _ => return Some(name.clone()),
    };
    Some(Ident::new(new, name.span()))
}

fn within(group: &Group) -> TokenTree {
    let delimiter: Delimiter = group.delimiter();
    let mut changed = Group::new(delimiter, blocking(group.stream()));
    changed.set_span(group.span());
    TokenTree::Group(changed)
}
