use super::*;

#[test]
fn paces_parse() {
    assert_eq!("settled".parse(), Ok(Pace::Settled));
    assert_eq!("0.5".parse(), Ok(Pace::PerSecond(0.5)));
    for text in ["", "0", "-1", "nan", "inf", "2000", "recorded", "10/s"] {
        assert_eq!(text.parse::<Pace>(), Err(PaceError(text.into())), "{text}");
    }
}
